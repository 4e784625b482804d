"""What reaches the terminal is inert, whole, and drawn where it belongs."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from solar_cli.cli.curve import plot
from solar_cli.cli.printing import as_json, clean, console, duration, table


@given(st.text())
def test_clean_text_is_one_line_without_controls(text: str) -> None:
    cleaned = clean(text)
    assert cleaned.isprintable() or all(c.isprintable() or c.isspace() for c in cleaned)
    assert not set(cleaned) & set("\n\r\t\x1b\x07\x9b\u202e\x00")
    cleaned.encode()


def test_ordinary_text_is_left_as_it_is() -> None:
    assert clean("θ̇ = v·tan φ, 3 × 10⁻³ [m]") == "θ̇ = v·tan φ, 3 × 10⁻³ [m]"


def test_a_table_shows_brackets_and_every_character_of_a_long_text(
    capsys: pytest.CaptureFixture[str],
) -> None:
    long = "[red]" + "x" * 150
    console().print(table(("a", "b>"), [(long, 1)]))
    out = capsys.readouterr().out
    assert "[red]" in out
    assert out.count("x") == 150


@given(st.recursive(st.floats() | st.text() | st.none(), st.lists, max_leaves=5))
def test_json_is_valid_whatever_is_in_it(data: object) -> None:
    json.loads(as_json(data), parse_constant=lambda name: pytest.fail(name))


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0 s"), (59.4, "59 s"), (200, "3 min 20 s"), (3600, "1 h 00 min"), (math.inf, "")],
)
def test_durations_are_read_at_a_glance(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def dots(lines: list[str]) -> set[tuple[int, int]]:
    """(column, row) of every dot, by the Braille block's own layout of bits."""
    order = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (0, 3), (1, 3)]
    found = set()
    for y, line in enumerate(lines[:-2]):
        for x, character in enumerate(line.partition("│")[2]):
            for bit, (column, row) in enumerate(order):
                if (ord(character) - 0x2800) >> bit & 1:
                    found.add((2 * x + column, 4 * y + row))
    return found


def test_a_falling_line_is_drawn_from_the_top_left_to_the_bottom_right() -> None:
    found = dots(plot([0, 10], [1.0, 0.0], width=4, height=2))
    assert found == {(column, column) for column in range(8)}  # 8 x 8 dots: the diagonal


def test_a_rising_line_is_its_mirror_image() -> None:
    found = dots(plot([0, 10], [0.0, 1.0], width=4, height=2))
    assert found == {(column, 7 - column) for column in range(8)}


def test_values_over_decades_are_drawn_on_a_logarithmic_axis() -> None:
    lines = plot([0, 1, 2], [1.0, 0.1, 0.01], width=4, height=2)
    assert "logarithmic" in lines[-1]
    near = [min(abs(c - r) for r in range(8) if (c, r) in dots(lines)) for c in range(8)]
    assert max(near) <= 1  # a straight line: powers of ten are equally far apart


def test_what_is_not_finite_leaves_a_gap() -> None:
    found = dots(plot([0, 1, 2], [1.0, math.nan, 1.0], width=4, height=2))
    assert {column for column, _ in found} == {0, 7}
    assert plot([0], [math.inf]) == ["(no finite value yet)"]


def test_a_single_point_is_drawn() -> None:
    assert len(dots(plot([5], [2.0], width=4, height=2))) == 1


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_terminal_without_braille_gets_stars_in_the_same_places(encoding: str) -> None:
    points = [0, 5, 10], [1.0, 0.2, 0.5]
    plain, drawn = plot(*points, encoding=encoding), plot(*points)
    assert "?" not in "".join(plain).encode(encoding, "replace").decode(encoding)
    for star, dotted in zip(plain[:12], drawn[:12], strict=True):
        assert [sign == "*" for sign in star] == [sign > "\u2800" for sign in dotted]
