"""Numbers and text as tables write them."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from solar_cli.reporting.statistics import Bounded, Interval
from solar_cli.reporting.tables import Table, bounded, interval, latex, markdown, number, ranges

INF = float("inf")


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.04321, "0.0432"), (12345.6, "12346"), (99.94, "99.9"), (-0.5, "-0.5"), (INF, "∞")],
)
def test_numbers_have_three_digits_or_are_whole(value, text):
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (Bounded(80, 80), "80"),
        (Bounded(240, INF), "> 240"),
        (Bounded(0, 3), "< 3"),
        (Bounded(1, 3), "1 to 3"),
        (Bounded(0, INF), "unknown"),
    ],
)
def test_a_bound_never_reads_as_a_number(value, text):
    assert bounded(value) == text


def test_an_interval_shows_its_coverage_where_it_carries_one():
    assert interval(Interval(0.1, INF, None)) == "[0.1, ∞]"
    assert interval(Interval(0.1, 0.2, 0.74)) == "[0.1, 0.2] (covers 0.74)"
    assert interval(None) == "-"


def test_ranges_of_seeds_are_short():
    assert ranges([3, 0, 1, 7, 2, 9, 10]) == "0-3, 7, 9-10"


@given(st.text())
def test_no_text_becomes_markup_or_a_second_line_in_markdown(text):
    shown = markdown(text)
    assert not re.search(r"<\S|(?<!\\)\|", shown)
    assert shown.isprintable()


def test_latex_escapes_what_latex_reads():
    assert latex("a_b & 5 % ± \\x{}") == r"a\_b \& 5 \% $\pm$ \textbackslash{}x\{\}"


def test_a_table_has_as_many_columns_in_each_line():
    table = Table(("method", "final"), (("a|b", "1 ± 2"), ("c", "3")), ("a note",))
    lines = table.to_markdown().splitlines()
    assert lines[:3] == ["| method | final |", "|---|---|", r"| a\|b | 1 ± 2 |"]
    assert lines[-1] == "- a note"
    body = table.to_latex()
    assert [body.count(rule) for rule in (r"\toprule", r"\midrule", r"\bottomrule")] == [1, 1, 1]
    assert r"a|b & 1 $\pm$ 2 \\" in body
