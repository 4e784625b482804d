"""Estimates against sums worked out by hand, brute force and SciPy; intervals against both."""

from collections import Counter
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from solar_cli.reporting.statistics import (
    Bounded,
    bootstrap,
    difference_interval,
    episode_bounds,
    episode_ratio,
    improvement,
    improvement_interval,
    iqm,
    iqm_interval,
    p_value,
    smallest_p,
    typical_episodes,
)

numbers = st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=12)


def array(*values: float) -> np.ndarray:
    return np.array(values, dtype=np.float64)


def bounds(*values: float, unreached: tuple[float, ...] = ()) -> np.ndarray:
    reached = np.array([True] * len(values) + [False] * len(unreached))
    return episode_bounds(array(*values, *unreached), reached)


def test_iqm_of_eight_values_is_the_mean_of_the_middle_four():
    assert iqm([8, 1, 7, 2, 6, 3, 5, 100]) == (3 + 5 + 6 + 7) / 4


def test_iqm_of_up_to_three_values_is_their_mean():
    assert iqm([1, 2, 9]) == 4


@given(numbers)
def test_iqm_is_scipys_mean_trimmed_by_a_quarter_at_each_end(values):
    assert iqm(values) == pytest.approx(stats.trim_mean(values, 0.25), rel=1e-12, abs=1e-9)


def test_improvement_counts_pairs_won_and_half_of_the_ties():
    # 1<2, 1<3, 2=2, 2<3: three wins and a tie in four pairs.
    assert improvement(array(1, 2), array(2, 3), "lower") == 3.5 / 4
    assert improvement(array(1, 2), array(2, 3), "higher") == 0.5 / 4


@given(numbers, numbers)
def test_improvement_is_mann_whitneys_u_over_the_number_of_pairs(left, right):
    u = stats.mannwhitneyu(left, right, method="asymptotic").statistic
    ours = improvement(np.array(left), np.array(right), "higher")
    assert ours == pytest.approx(u / (len(left) * len(right)), abs=1e-12)


def test_bootstrap_draws_each_resample_with_its_probability():
    drawn = Counter(bootstrap([array(0, 1)], lambda x: x.mean(axis=-1)).tolist())
    # Binomial(2, 1/2); five standard errors of a share of 10 000 draws are 0.025.
    for value, share in ((0.0, 0.25), (0.5, 0.5), (1.0, 0.25)):
        assert drawn[value] / 10_000 == pytest.approx(share, abs=0.025)


def test_bootstrap_resamples_each_stratum_at_its_own_size():
    low, high = array(0, 0), array(1, 1, 1)
    sums = bootstrap([low, high], lambda x, y: np.concatenate([x, y], axis=-1).sum(axis=-1))
    assert set(sums.tolist()) == {3.0}  # mixed strata would give anything from 0 to 5


def test_the_same_samples_give_the_same_interval_whatever_was_drawn_before():
    sample = np.random.default_rng(0).normal(size=10)
    first = iqm_interval(sample)
    np.random.default_rng(1).normal(size=5)
    iqm_interval(sample[:5])
    assert iqm_interval(sample) == first


def test_a_single_seed_has_no_interval():
    one, many = array(1), array(1, 2, 3)
    assert iqm_interval(one) is None
    assert difference_interval(one, many) is None
    assert improvement_interval(many, one, "lower") is None
    assert episode_ratio(bounds(1), bounds(1, 2))[1] is None


def test_an_interval_of_equal_values_is_a_point():
    interval = iqm_interval(np.full(12, 0.25))
    assert (interval.low, interval.high, interval.coverage) == (0.25, 0.25, None)


def test_iqm_interval_agrees_with_rliables_definition_by_brute_force():
    # Three tasks of two runs: all 4^3 stratified resamples are enumerated.
    tasks = [array(0, 1), array(2, 4), array(3, 9)]
    exact = sorted(
        stats.trim_mean(np.concatenate(resample), 0.25)
        for resample in product(*(list(product(task, repeat=2)) for task in tasks))
    )
    interval = iqm_interval(*tasks)
    # Resamples are equally likely; 2.5 % of 64 lies inside the second one from each end.
    assert interval.low == pytest.approx(exact[1], abs=1e-12)
    assert interval.high == pytest.approx(exact[-2], abs=1e-12)


@pytest.mark.parametrize("seeds", [5, 20])
def test_intervals_agree_with_scipys_bootstrap(seeds):
    stream = np.random.default_rng(seeds)
    left, right = stream.normal(size=seeds), stream.normal(1, 2, size=seeds)
    ours = difference_interval(left, right)
    theirs = stats.bootstrap(
        (left, right),
        lambda x, y, axis: x.mean(axis=axis) - y.mean(axis=axis),
        method="percentile",
        vectorized=True,
        n_resamples=20_000,
        rng=np.random.default_rng(1),
    ).confidence_interval
    # Monte Carlo error of each end is below 1 % of the length; both have one: five of those.
    tolerance = 0.07 * (theirs.high - theirs.low)
    assert ours.low == pytest.approx(theirs.low, abs=tolerance)
    assert ours.high == pytest.approx(theirs.high, abs=tolerance)


def test_below_ten_seeds_an_interval_carries_its_coverage():
    sample = np.random.default_rng(0).normal(size=10)
    assert iqm_interval(sample[:9]).coverage == 0.93
    assert iqm_interval(sample).coverage is None
    assert difference_interval(sample, sample[:3]).coverage == 0.72  # the smaller sample counts
    assert improvement_interval(sample[:4], sample, "lower").coverage == 0.84
    assert episode_ratio(bounds(*[60] * 3), bounds(*[60] * 10))[1].coverage == 0.90


def test_three_against_three_seeds_cannot_reach_five_percent():
    assert smallest_p(3, 3) == 0.1
    assert smallest_p(4, 4) == pytest.approx(2 / 70)
    assert p_value(array(1, 2, 3), array(4, 5, 6)) == pytest.approx(0.1)


@pytest.mark.parametrize(("left", "right"), [(4, 5), (6, 3), (10, 10), (20, 20), (1, 7)])
def test_p_value_is_mann_whitneys_exact_one_without_ties(left, right):
    stream = np.random.default_rng(left)
    x, y = stream.normal(size=left), stream.normal(0.8, 1, size=right)
    exact = stats.mannwhitneyu(x, y, method="exact").pvalue
    assert p_value(x, y) == pytest.approx(exact, abs=1e-12)


def test_p_value_with_ties_counts_relabellings():
    x, y = array(0, 0, 1, 1), array(1, 2, 2, 2)
    ranks = stats.rankdata([*x, *y])
    sums = np.array([ranks[list(chosen)].sum() for chosen in combinations(range(8), 4)])
    observed = ranks[:4].sum()
    one_sided = min((sums <= observed).mean(), (sums >= observed).mean())
    assert p_value(x, y) == pytest.approx(min(1, 2 * one_sided), abs=1e-12)


def test_typical_episodes_is_the_median_where_all_seeds_reach_the_level():
    assert typical_episodes(bounds(60, 80, 120, 200)) == Bounded(100, 100)


def test_a_seed_that_never_reached_the_level_is_a_lower_bound_not_a_gap():
    assert typical_episodes(bounds(60, unreached=(240, 240))) == Bounded(240, np.inf)
    # With one of three missing the median is known all the same.
    assert typical_episodes(bounds(60, 80, unreached=(240,))) == Bounded(80, 80)
    # A short run that stopped early is not known to be the slower one.
    assert typical_episodes(bounds(60, 80, unreached=(20,))) == Bounded(60, 80)


def test_episode_ratio_is_left_over_right():
    ratio, interval = episode_ratio(bounds(*[200] * 3), bounds(*[100] * 3))
    assert ratio == Bounded(2, 2)
    assert (interval.low, interval.high) == (2, 2)


def test_the_ratio_of_a_level_never_reached_is_a_bound():
    never, reached = bounds(unreached=(240, 240, 240)), bounds(60, 80, 80)
    ratio, interval = episode_ratio(never, reached)
    assert ratio == Bounded(3, np.inf)
    assert (interval.low, interval.high) == (3, np.inf)
    ratio, interval = episode_ratio(reached, never)
    assert ratio == Bounded(0, 1 / 3)
    assert (interval.low, interval.high) == (0, pytest.approx(1 / 3))
    assert episode_ratio(never, never)[0] == Bounded(0, np.inf)


def test_a_level_that_the_first_policy_meets_bounds_no_ratio():
    assert episode_ratio(bounds(0, 0), bounds(0, 0))[0] == Bounded(0, np.inf)
    assert episode_ratio(bounds(60, 80), bounds(0, 0))[0] == Bounded(np.inf, np.inf)


seeds_to_level = st.lists(st.tuples(st.integers(1, 300), st.booleans()), min_size=1, max_size=6)


@given(seeds_to_level, seeds_to_level, st.data())
def test_bounds_of_a_ratio_hold_whatever_the_unseen_episodes_are(left, right, data):
    def completed(side):
        return [n if reached else n + data.draw(st.integers(0, 2000)) for n, reached in side]

    truth = np.median(completed(left)) / np.median(completed(right))
    sides = [
        episode_bounds(array(*(n for n, _ in side)), np.array([r for _, r in side]))
        for side in (left, right)
    ]
    ratio, _ = episode_ratio(*sides, replicates=10)
    assert ratio.low <= truth * (1 + 1e-12)
    assert truth <= ratio.high * (1 + 1e-12)
