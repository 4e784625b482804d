"""Where the time went adds up to all of it."""

import pytest
from hand_made import cell, compute, database

from solar_cli.reporting.curves import problems
from solar_cli.reporting.summary import summarise, table
from solar_cli.reporting.timing import OTHER, note, shares


def test_shares_are_sums_over_iterations_and_cells_and_the_rest(tmp_path):
    with database(tmp_path) as store:
        train = {"seconds_training": [1.0, 0.5], "seconds_saving": [0.25, 0.25], "elbo": [9.0, 9.0]}
        compute(store, cell(seed=0), [1.0, 0.5, 0.4], train=train)  # 4 s of computing
        compute(store, cell(seed=1), [1.0, 0.5], train={"seconds_training": [0.5]})  # 2 s
        found = {share.activity: share for share in shares(store, store.cells())}
    assert {name: share.seconds for name, share in found.items()} == {
        "training networks": 2.0,
        "saving": 0.5,
        OTHER: 3.5,
    }
    assert found["saving"].share == pytest.approx(0.5 / 6)
    assert sum(share.share for share in found.values()) == pytest.approx(1)


def test_a_report_says_it_in_a_line_a_curve_the_most_first(tmp_path):
    with database(tmp_path) as store:
        train = {"seconds_training": [0.4], "seconds_control": [1.4], "seconds_saving": [0.001]}
        compute(store, cell(), [1.0, 0.5], train=train)
        (problem,) = problems(store)
        summary = summarise(store, problem.curves[0], {}, {})
    said = "solar: its computing was 70% all else that the method does, 20% training networks, "
    assert [line for line in table(problem, [summary]).notes if line.startswith(said)]


def test_where_nothing_was_measured_nothing_is_said(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell(), [1.0, 0.5], train={"elbo": [1.0]})
        assert shares(store, store.cells()) == []
        assert shares(store, []) == []
    assert note("solar", []) == []
