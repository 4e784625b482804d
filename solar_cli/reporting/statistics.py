"""Statistics over seeds: estimates, seeded bootstrap intervals, an exact test, episode ratios.

A *sample* has one entry a seed. Two samples are treated as independent: the same seed of two
methods may share the starts of its evaluation episodes, which makes an interval of their difference
too long rather than too short. Interquartile mean and probability of improvement are those of
Agarwal et al. 2021 (Deep RL at the edge of the statistical precipice). Intervals are 95 %
percentile bootstrap intervals; below ten seeds each carries how often such an interval was right
when that was measured (`coverage`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import comb
from typing import Literal

import numpy as np
import numpy.typing as npt

from solar_cli.reporting.coverage import Statistic, measured
from solar_cli.streams import Streams

Array = npt.NDArray[np.float64]
Better = Literal["lower", "higher"]

REPLICATES = 10_000
"""Resamplings of an interval: the Monte Carlo error of an end is then under 1 % of its length."""
LEVEL = 0.05
"""Error level of a verdict, and what an interval leaves out."""


@dataclass(frozen=True)
class Interval:
    """A 95 % interval."""

    low: float
    high: float
    coverage: float | None
    """measured share of such intervals that hold the truth; None from ten seeds on"""


@dataclass(frozen=True)
class Bounded:
    """A number known to lie in [low, high]; the ends are equal where it is known."""

    low: float
    high: float


def iqm(values: npt.ArrayLike) -> Array:
    """Interquartile mean over the last axis: the mean without the lowest and the highest quarter.

    A quarter is rounded down to whole values, so that the IQM of up to three values is their mean.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=-1)
    cut = ordered.shape[-1] // 4
    kept: Array = ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)
    return kept


def improvement(left: Array, right: Array, better: Better) -> Array:
    """Probability that a seed of ``left`` beats one of ``right``; a tie counts half.

    Shapes (..., n) and (..., m) give (...).
    """
    sign = 1.0 if better == "higher" else -1.0
    gap = sign * (left[..., :, None] - right[..., None, :])
    share: Array = ((gap > 0) + 0.5 * (gap == 0)).mean(axis=(-2, -1))
    return share


def bootstrap(
    samples: Sequence[Array], statistic: Callable[..., Array], replicates: int = REPLICATES
) -> Array:
    """Values of ``statistic`` on resampled data.

    Every sample (n, ...) is a stratum: drawn with replacement on its own, at its own size, and
    handed to ``statistic`` as an array (replicates, n, ...). The stream is fixed: the same samples
    give the same values.
    """
    stream = Streams(0).generator("reporting", "bootstrap")
    return statistic(
        *(
            sample[stream.integers(len(sample), size=(replicates, len(sample)))]
            for sample in samples
        )
    )


def _interval(
    name: Statistic,
    samples: Sequence[Array],
    statistic: Callable[..., Array],
    replicates: int = REPLICATES,
) -> Interval | None:
    """Middle 95 % of the bootstrap values; None where a sample has one seed, so nothing to draw."""
    seeds = min(len(sample) for sample in samples)
    if seeds < 2:
        return None
    low, high = np.quantile(bootstrap(samples, statistic, replicates), [LEVEL / 2, 1 - LEVEL / 2])
    return Interval(float(low), float(high), measured(name, seeds))


def iqm_interval(*strata: Array, replicates: int = REPLICATES) -> Interval | None:
    """Stratified bootstrap interval of the `iqm` of all values together; a stratum is one task."""

    def pooled(*drawn: Array) -> Array:
        return iqm(np.concatenate(drawn, axis=-1))

    return _interval("iqm", strata, pooled, replicates)


def difference_interval(left: Array, right: Array, replicates: int = REPLICATES) -> Interval | None:
    """Bootstrap interval of mean(left) - mean(right)."""

    def difference(x: Array, y: Array) -> Array:
        gap: Array = x.mean(axis=-1) - y.mean(axis=-1)
        return gap

    return _interval("difference", (left, right), difference, replicates)


def improvement_interval(
    left: Array, right: Array, better: Better, replicates: int = REPLICATES
) -> Interval | None:
    """Bootstrap interval of `improvement`."""

    def probability(x: Array, y: Array) -> Array:
        return improvement(x, y, better)

    return _interval("improvement", (left, right), probability, replicates)


def smallest_p(left_seeds: int, right_seeds: int) -> float:
    """The smallest two-sided p-value that any outcome can have at these numbers of seeds."""
    return min(1.0, 2 / comb(left_seeds + right_seeds, left_seeds))


def p_value(left: Array, right: Array) -> float:
    """Two-sided permutation test of `improvement` = 1/2 (Mann-Whitney), exact with ties too.

    Every way to call n of the n + m seeds "left" is equally likely where there is no difference;
    the sums of their ranks are counted by adding one seed after another.
    """
    pooled = np.concatenate([left, right])
    ordered = np.sort(pooled)
    ranks = (  # twice the mean rank of tied values: whole
        np.searchsorted(ordered, pooled, "left") + np.searchsorted(ordered, pooled, "right") + 1
    )
    count, observed = len(left), int(ranks[: len(left)].sum())
    ways = np.zeros((count + 1, int(ranks.sum()) + 1))  # [seeds called left, sum of their ranks]
    ways[0, 0] = 1
    for rank in ranks.tolist():
        ways[1:, rank:] += ways[:-1, : ways.shape[1] - rank]
    chances = ways[count] / ways[count].sum()
    tails = chances[: observed + 1].sum(), chances[observed:].sum()
    return float(min(1.0, 2 * min(tails)))


def episode_bounds(episodes: Array, reached: npt.NDArray[np.bool_]) -> Array:
    """Bounds (n, 2) of the episodes that each seed needs to reach a level.

    Where ``reached`` is false, ``episodes`` says how far the seed was seen not to reach it.
    """
    return np.stack([episodes, np.where(reached, episodes, np.inf)], axis=-1)


def typical_episodes(bounds: Array) -> Bounded:
    """Median over seeds of `episode_bounds` (n, 2).

    A median grows with each of its entries, so it lies between the medians of the bounds. Where
    those agree it does not depend on what was not seen.
    """
    low, high = np.median(bounds, axis=-2)
    return Bounded(float(low), float(high))


def episode_ratio(
    left: Array, right: Array, replicates: int = REPLICATES
) -> tuple[Bounded, Interval | None]:
    """How many times the episodes of ``right`` does ``left`` need? From `episode_bounds` of both.

    Returns the ratio of the medians with its bootstrap interval, from the 2.5 % point of the lower
    bounds to the 97.5 % point of the upper bounds: 0 or infinity where nothing is known.
    """
    low, high = _ratio(left[None], right[None])
    ratio = Bounded(float(low[0]), float(high[0]))
    seeds = min(len(left), len(right))
    if seeds < 2:
        return ratio, None
    lows, highs = bootstrap((left, right), _ratio, replicates)
    return ratio, Interval(
        # no interpolation between values that may be infinite
        float(np.quantile(lows, LEVEL / 2, method="lower")),
        float(np.quantile(highs, 1 - LEVEL / 2, method="higher")),
        measured("ratio", seeds),
    )


def _ratio(left: Array, right: Array) -> Array:
    """Bounds (2, replicates) of median(left) / median(right); 0/0 and inf/inf bound nothing."""
    left_low, left_high = np.median(left, axis=-2).T
    right_low, right_high = np.median(right, axis=-2).T
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = left_low / right_high, left_high / right_low
    return np.stack([np.where(np.isnan(low), 0.0, low), np.where(np.isnan(high), np.inf, high)])
