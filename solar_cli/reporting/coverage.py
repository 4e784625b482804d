"""How often our 95 % intervals hold the truth at few seeds, as measured.

A percentile bootstrap interval of few values is too short. Every interval that is shown below ten
seeds carries its figure from `TABLE`, which is made by

    python -m solar_cli.reporting.coverage

For each number of seeds n and each population of `populations` it draws `TRIALS` samples (two of n
seeds each where two methods are compared), makes the interval as the report does, and counts how
often it holds the population's value. The table keeps the population where that is least often;
its standard error is 0.008 at most.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Literal, get_args

from solar_cli.streams import Streams

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

Statistic = Literal["iqm", "difference", "improvement", "ratio"]
ENOUGH = 10
"""From this many seeds on an interval is shown without its coverage."""
TRIALS = 4000
REPLICATES = 2000
"""Resamplings an interval has in the simulation."""

TABLE: dict[Statistic, dict[int, float]] = {
    "iqm": {2: 0.49, 3: 0.74, 4: 0.86, 5: 0.90, 6: 0.91, 7: 0.90, 8: 0.93, 9: 0.93},
    "difference": {2: 0.57, 3: 0.72, 4: 0.77, 5: 0.80, 6: 0.82, 7: 0.83, 8: 0.84, 9: 0.85},
    "improvement": {2: 0.51, 3: 0.72, 4: 0.84, 5: 0.88, 6: 0.89, 7: 0.92, 8: 0.91, 9: 0.92},
    "ratio": {2: 0.67, 3: 0.90, 4: 0.93, 5: 0.97, 6: 0.96, 7: 0.96, 8: 0.96, 9: 0.97},
}


def measured(statistic: Statistic, seeds: int) -> float | None:
    """Measured coverage of a 95 % interval of ``statistic`` at so many seeds; None from ten on."""
    return TABLE[statistic].get(seeds)


Draw = Callable[["np.random.Generator", int], "npt.NDArray[np.float64]"]


def populations(statistic: Statistic) -> Iterator[tuple[str, Draw, Draw, float]]:
    """Names, the two populations, and the true value of ``statistic``.

    Final performance is taken as normal and as log-normal (a few bad seeds); episodes to a level as
    log-normal. The second population of a comparison is the same or shifted by one unit.
    """
    from math import exp, sqrt

    from scipy.stats import norm

    def normal(stream: np.random.Generator, seeds: int) -> npt.NDArray[np.float64]:
        return stream.normal(size=seeds)

    def shifted(stream: np.random.Generator, seeds: int) -> npt.NDArray[np.float64]:
        return stream.normal(size=seeds) + 1

    def skewed(stream: np.random.Generator, seeds: int) -> npt.NDArray[np.float64]:
        return stream.lognormal(size=seeds)

    def doubled(stream: np.random.Generator, seeds: int) -> npt.NDArray[np.float64]:
        return 2 * stream.lognormal(size=seeds)

    if statistic == "iqm":
        quarter = norm.ppf(0.75)
        middle = 2 * exp(0.5) * (norm.cdf(quarter - 1) - norm.cdf(-quarter - 1))
        yield "normal", normal, normal, 0.0
        yield "log-normal", skewed, skewed, float(middle)
    elif statistic == "difference":
        yield "normal", normal, shifted, -1.0
        yield "log-normal", skewed, doubled, -exp(0.5)
    elif statistic == "improvement":
        yield "the same", normal, normal, 0.5
        yield "shifted", shifted, normal, float(norm.cdf(1 / sqrt(2)))
    else:
        yield "log-normal", doubled, skewed, 2.0


def simulate(statistic: Statistic, seeds: int, trials: int = TRIALS) -> dict[str, float]:
    """Share of trials whose interval holds the true value, by population."""
    import numpy as np

    from solar_cli.reporting import statistics

    def interval(
        x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
    ) -> statistics.Interval | None:
        if statistic == "iqm":
            return statistics.iqm_interval(x, replicates=REPLICATES)
        if statistic == "difference":
            return statistics.difference_interval(x, y, REPLICATES)
        if statistic == "improvement":
            return statistics.improvement_interval(x, y, "higher", REPLICATES)
        known = np.ones(seeds, dtype=bool)
        left, right = (statistics.episode_bounds(sample, known) for sample in (x, y))
        return statistics.episode_ratio(left, right, REPLICATES)[1]

    shares = {}
    for name, first, second, truth in populations(statistic):
        stream = Streams(0).generator("reporting", "coverage", statistic, name, seeds)
        held = 0
        for _ in range(trials):
            made = interval(first(stream, seeds), second(stream, seeds))
            held += made is not None and made.low <= truth <= made.high
        shares[name] = held / trials
    return shares


if __name__ == "__main__":
    for statistic in get_args(Statistic):
        row = {seeds: min(simulate(statistic, seeds).values()) for seeds in range(2, ENOUGH)}
        print(f'    "{statistic}": {{' + ", ".join(f"{n}: {v:.2f}" for n, v in row.items()) + "},")
