"""The table of results says nothing that its numbers do not hold."""

import pytest
from hand_made import cell, compute, database

from solar_cli.reporting.curves import problems
from solar_cli.reporting.statistics import Interval
from solar_cli.reporting.summary import caveats, flat, line, summarise, table


@pytest.mark.parametrize(("seeds", "shown"), [(1, "0.5 ± –"), (2, "0.5 ± 0")])
def test_a_single_seed_has_no_spread(tmp_path, seeds, shown):
    with database(tmp_path) as store:
        for seed in range(seeds):
            compute(store, cell(seed=seed), [1.0, 0.5])
        (problem,) = problems(store)
        summary = summarise(store, problem.curves[0], {}, {})
    assert flat(problem, summary)["std"] == (None if seeds == 1 else 0.0)
    made = table(problem, [summary])
    assert made.rows[0][3] == shown
    assert f"final_distance {shown} " in line(problem, summary)
    assert any("95 %" in note for note in made.notes) == (summary.interval is not None)


def test_the_explanation_of_coverage_stands_only_where_a_coverage_does():
    plain, covered = Interval(0.0, 1.0, None), Interval(0.0, 1.0, 0.7)
    assert caveats([None]) == []
    assert ["covers" in note for note in caveats([plain, None])] == [False]
    assert ["covers" in note for note in caveats([plain, covered])] == [True]
