"""The table of measured coverage is what its simulation gives."""

from typing import get_args

import pytest

from solar_cli.reporting.coverage import ENOUGH, TABLE, Statistic, measured, simulate

TRIALS = 400


@pytest.mark.parametrize("statistic", get_args(Statistic))
@pytest.mark.parametrize("seeds", [3, 5])
def test_the_table_is_what_the_simulation_gives(statistic, seeds):
    worst = min(simulate(statistic, seeds, TRIALS).values())
    # Four standard errors of a share near 0.8 in 400 trials.
    assert measured(statistic, seeds) == pytest.approx(worst, abs=0.08)


def test_intervals_of_twenty_seeds_hold_the_truth_about_as_often_as_they_say():
    # 0.95 less what a percentile interval is known to miss at 20 seeds, less four standard errors.
    assert simulate("iqm", 20, TRIALS)["normal"] >= 0.89


def test_every_number_of_seeds_below_ten_has_a_figure_and_none_from_there_on():
    for statistic in get_args(Statistic):
        assert sorted(TABLE[statistic]) == list(range(2, ENOUGH))
        assert measured(statistic, ENOUGH) is None
