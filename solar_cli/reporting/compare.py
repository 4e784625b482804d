"""Two methods on the same problems: difference, probability of improvement, episodes, verdict.

The verdict comes from a permutation test of the probability of improvement at the 5 % level, on one
number a seed: the headline measure at the end of each curve.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any, Literal

from solar_cli.errors import SolarError, UsageError, nearest
from solar_cli.experiment.provenance import code
from solar_cli.reporting.curves import Curve, Problem, problems
from solar_cli.reporting.evidence import notes
from solar_cli.reporting.statistics import (
    LEVEL,
    Bounded,
    Interval,
    difference_interval,
    episode_ratio,
    improvement,
    improvement_interval,
    p_value,
    smallest_p,
)
from solar_cli.reporting.summary import caveats, title
from solar_cli.reporting.tables import Table, bounded, interval, markdown, number, one_line
from solar_cli.settings.registry import is_level
from solar_cli.store.store import Store
from solar_cli.wording import counted

BASELINE = "solar"

Verdict = Literal["better", "worse", "undecided"]


@dataclass(frozen=True)
class Side:
    """One curve of a pair."""

    label: str
    mean: float
    """final performance"""
    std: float | None
    """over seeds; None for one"""
    episodes: int
    """where the curve ends, and its final performance is taken"""
    seeds: int


@dataclass(frozen=True)
class Ratio:
    """Episodes of the left method over those of the right one, to reach one level."""

    level: float
    ratio: Bounded
    interval: Interval | None


@dataclass(frozen=True)
class Pair:
    """Left against right on one problem."""

    problem: str
    measure: str
    unit: str
    better: Literal["lower", "higher"]
    left: Side
    right: Side
    difference: float
    """mean of left minus mean of right, in the measure's unit"""
    difference_interval: Interval | None
    improvement: float
    """probability that a seed of left beats one of right"""
    improvement_interval: Interval | None
    ratios: tuple[Ratio, ...]
    p: float
    """two-sided, of ``improvement`` = 1/2"""
    verdict: Verdict
    """on left"""
    why: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Comparison:
    """All pairs that were asked for."""

    pairs: tuple[Pair, ...]

    @property
    def tables(self) -> dict[str, Table]:
        """One table a problem."""
        by_problem: dict[str, list[Pair]] = {}
        for pair in self.pairs:
            by_problem.setdefault(pair.problem, []).append(pair)
        return {problem: _table(pairs) for problem, pairs in by_problem.items()}

    def to_markdown(self) -> str:
        """A heading and a table a problem."""
        return "\n".join(
            f"## {markdown(problem)}\n\n{table.to_markdown()}"
            for problem, table in self.tables.items()
        )

    def to_latex(self) -> str:
        """A tabular a problem."""
        return "\n".join(
            f"% {one_line(problem)}\n{table.to_latex()}" for problem, table in self.tables.items()
        )

    def to_json(self) -> str:
        """A list of pairs; an infinite bound is null."""
        return json.dumps(_plain([asdict(pair) for pair in self.pairs]), indent=2, allow_nan=False)


def compare(
    store: Store,
    left: str | None = None,
    right: str | None = None,
    tasks: Collection[str] = (),
) -> Comparison:
    """Compare two methods, given as ``METHOD`` or ``METHOD:VARIANT``, on every problem of both.

    Where ``tasks`` are named, on theirs alone.

    Without ``right`` it is ``solar``; without both, every method and variant is compared with
    `baseline_of` every problem. Raises `UsageError` for a name the store has no curve of, and
    `SolarError` where there is nothing to compare.
    """
    present = code()

    def pair(problem: Problem, one: Curve, other: Curve, *more: str) -> Pair:
        said = [*more, *notes(store, one, present), *notes(store, other, present)]
        return compare_curves(problem, one, other, said)

    every = problems(store)
    found = [problem for problem in every if not tasks or problem.task in tasks]
    if left is None:
        pairs = [
            pair(problem, curve, baseline, *stands_in(baseline))
            for problem in found
            if (baseline := baseline_of(problem))
            for curve in problem.curves
            if curve is not baseline
        ]
    else:
        names = [_known(every, left), _known(every, right or BASELINE)]
        if names[0] == names[1]:
            raise UsageError(f"{left!r} and {right or BASELINE!r} are the same: name two")
        pairs = [
            pair(problem, one, other)
            for problem in found
            if (one := problem.curve(names[0])) and (other := problem.curve(names[1]))
        ]
    if not pairs:
        both = "two methods" if left is None else f"both {left!r} and {right or BASELINE!r}"
        where = f"no problem of task {' or '.join(map(repr, tasks))}" if tasks else "no problem"
        raise SolarError(
            f"nothing to compare in {store}: {where} has curves of {both}; "
            "`solar run --task nav --method solar --method vae --seeds 5` makes some"
        )
    return Comparison(tuple(pairs))


def baseline_of(problem: Problem) -> Curve | None:
    """What others are compared with: ``solar``, else one of its variants, else of what learns."""
    plain = [curve for curve in problem.curves if "@" not in curve.label]
    own = [curve for curve in plain if curve.method == BASELINE]
    learned = [curve for curve in plain if not is_level(curve.method)]
    return problem.curve(BASELINE) or next(iter([*own, *learned]), None)


def stands_in(baseline: Curve) -> list[str]:
    """What to know where others are compared with something else than ``solar``: or nothing.

    Of `baseline_of`; what was asked for stands in for nothing.
    """
    if baseline.label == BASELINE:
        return []
    missing = f"{BASELINE} of the default variant" if baseline.method == BASELINE else BASELINE
    return [f"there is no {missing}: {baseline.label} stands in for it"]


def _known(found: list[Problem], name: str) -> str:
    """The label of ``name``. Raises `UsageError` where no problem has a curve of it."""
    label = name.removesuffix(":default")
    labels = {curve.label for problem in found for curve in problem.curves}
    if label not in labels:
        raise UsageError(f"no evaluated cell of {name!r}: {nearest(label, labels)}")
    return label


def compare_curves(problem: Problem, left: Curve, right: Curve, said: list[str]) -> Pair:
    """The numbers of one pair; ``said`` are the notes on both curves."""
    measure = problem.measure
    better = float(improvement(left.final, right.final, measure.better))
    p = p_value(left.final, right.final)
    verdict, why = judge(better, p, len(left.seeds), len(right.seeds))
    return Pair(
        problem=problem.title,
        measure=measure.headline,
        unit=measure.unit,
        better=measure.better,
        left=_side(left),
        right=_side(right),
        difference=float(left.mean[-1] - right.mean[-1]),
        difference_interval=difference_interval(left.final, right.final),
        improvement=better,
        improvement_interval=improvement_interval(left.final, right.final, measure.better),
        ratios=tuple(
            Ratio(level, *episode_ratio(left.bounds(level), right.bounds(level)))
            for level in measure.levels
        ),
        p=p,
        verdict=verdict,
        why=why,
        notes=(*said, *_unequal(left, right)),
    )


def _unequal(left: Curve, right: Curve) -> list[str]:
    """What to know where one side has had more episodes than the other."""
    if left.end == right.end:
        return []
    return [
        f"{left.label} ends at {counted(left.end, 'episode')}, {right.label} at {right.end}: their "
        "final values are of unequal budgets; `solar run --budget N` goes on with the shorter"
    ]


def _side(curve: Curve) -> Side:
    return Side(curve.label, float(curve.mean[-1]), curve.final_std, curve.end, len(curve.seeds))


def judge(better: float, p: float, left_seeds: int, right_seeds: int) -> tuple[Verdict, str]:
    """The verdict on left and its reason: undecided where no outcome could have decided."""
    smallest = smallest_p(left_seeds, right_seeds)
    if smallest > LEVEL:
        return "undecided", (
            f"{left_seeds} against {counted(right_seeds, 'seed')} cannot reach p <= {LEVEL}: "
            f"the smallest p is {smallest:.2g}"
        )
    if p > LEVEL:
        return "undecided", f"p = {p:.2g}"
    return ("better" if better > 0.5 else "worse"), f"p = {p:.2g}"


def _table(pairs: list[Pair]) -> Table:
    """Pairs of one problem as text."""
    first = pairs[0]
    levels = [ratio.level for ratio in first.ratios]
    columns = (
        "left",
        "right",
        "final, left",
        "final, right",
        "difference",
        "P(left beats right)",
        *(f"episodes to {number(level)}, left / right" for level in levels),
        "left is",
    )
    rows = tuple(
        (
            pair.left.label,
            pair.right.label,
            *(f"{number(side.mean)} at {side.episodes}" for side in (pair.left, pair.right)),
            f"{number(pair.difference)} {interval(pair.difference_interval)}",
            f"{number(pair.improvement)} {interval(pair.improvement_interval)}",
            *(f"{bounded(ratio.ratio)} {interval(ratio.interval)}" for ratio in pair.ratios),
            f"{pair.verdict} ({pair.why})",
        )
        for pair in pairs
    )
    said = (
        f"Final: mean over seeds of {title(first.measure, first.unit, first.better)}, at the "
        "episodes where the curve ends. Ratios of episodes are of the medians over seeds.",
        *caveats(
            one
            for pair in pairs
            for one in (
                pair.difference_interval,
                pair.improvement_interval,
                *(ratio.interval for ratio in pair.ratios),
            )
        ),
        "Verdicts are of a permutation test at the 5 % level, for each pair on its own: of many "
        "pairs some are decided by chance.",
        *dict.fromkeys(note for pair in pairs for note in pair.notes),
    )
    return Table(columns, rows, said)


def _plain(data: Any) -> Any:
    """JSON data: tuples as lists, what is not finite as null."""
    if isinstance(data, float) and not math.isfinite(data):
        return None
    if isinstance(data, dict):
        return {key: _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    return data
