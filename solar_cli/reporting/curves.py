"""Learning curves: the headline measure against episodes, over seeds, by the rules of evidence.

Seeds are put on one grid, the union of their evaluated episode counts; between two evaluations a
seed has its last value. A curve ends where its shortest seed ends. A seed that diverged stays in at
its value when it diverged or its starting value, whichever is worse. Different configurations are
never in one curve, whatever their names; different code is, with a note.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from solar_cli.reporting.statistics import Array, Better, episode_bounds
from solar_cli.settings import Cell, EvaluationSettings
from solar_cli.settings.schema import hashed_values
from solar_cli.store.records import CellRecord, State
from solar_cli.store.store import Store

Counts = npt.NDArray[np.int64]
EVALUATION_SPLIT = "noise_free"


def at_least_as_good(values: npt.ArrayLike, level: float, better: Better) -> npt.NDArray[np.bool_]:
    """Whether each value reaches ``level``."""
    numbers = np.asarray(values, dtype=np.float64)
    return numbers <= level if better == "lower" else numbers >= level


@dataclass(frozen=True)
class SeedCurve:
    """The evaluations of one cell that has any with a finite value."""

    record: CellRecord
    episodes: Counts
    """of each evaluation, increasing, shape (E,)"""
    values: Array
    """finite, shape (E,)"""
    diverged: bool
    better: Better

    @property
    def seed(self) -> int:
        """The cell's seed."""
        return self.record.cell.seed

    @property
    def end(self) -> float:
        """Episodes up to which the seed has a value: infinite for one that diverged."""
        return np.inf if self.diverged else float(self.episodes[-1])

    @property
    def penalty(self) -> float:
        """What a diverged seed counts as from then on: the worse of its last and first value."""
        ends = self.values[[0, -1]]
        return float(ends.max() if self.better == "lower" else ends.min())

    def on(self, grid: Counts) -> Array:
        """Its value at each episode count of ``grid``, all from its first evaluation on."""
        values = self.values[np.searchsorted(self.episodes, grid, side="right") - 1]
        if self.diverged:
            values = np.where(grid > self.episodes[-1], self.penalty, values)
        return values

    def first_reaching(self, level: float) -> int | None:
        """The first evaluated episode count whose value is at least as good as ``level``."""
        reached = at_least_as_good(self.values, level, self.better)
        return int(self.episodes[reached.argmax()]) if reached.any() else None


@dataclass(frozen=True)
class Curve:
    """All seeds of one task, method, variant and configuration."""

    label: str
    """``method``, ``method:variant``; an older configuration of it with ``@`` and its hash"""
    method: str
    variant: str
    key: str
    """hash of the configuration without the seed"""
    measure: EvaluationSettings
    records: tuple[CellRecord, ...]
    """every cell, by seed, also those without a value"""
    seeds: tuple[SeedCurve, ...]
    """those with a value; at least one"""

    @cached_property
    def grid(self) -> Counts:
        """Episode counts from where all seeds have a value to where the first of them ends."""
        start = max(int(seed.episodes[0]) for seed in self.seeds)
        end = min(seed.end for seed in self.seeds)
        counts = np.unique(np.concatenate([seed.episodes for seed in self.seeds]))
        inside = counts[(counts >= start) & (counts <= end)]
        # A seed that ends before another begins leaves no common count: stay at the later one.
        return inside if len(inside) else np.array([start])

    @cached_property
    def values(self) -> Array:
        """Shape (seeds, grid)."""
        return np.stack([seed.on(self.grid) for seed in self.seeds])

    @property
    def mean(self) -> Array:
        """Mean over seeds, shape (grid,)."""
        mean: Array = self.values.mean(axis=0)
        return mean

    @property
    def std(self) -> Array | None:
        """Sample standard deviation over seeds, shape (grid,); None for one seed."""
        if len(self.seeds) == 1:
            return None
        std: Array = self.values.std(axis=0, ddof=1)
        return std

    @property
    def final_std(self) -> float | None:
        """`std` at the end of the curve."""
        return None if self.std is None else float(self.std[-1])

    @property
    def final(self) -> Array:
        """One number a seed: its value at the end of the curve."""
        final: Array = self.values[:, -1]
        return final

    @property
    def end(self) -> int:
        """Episodes at the end of the curve."""
        return int(self.grid[-1])

    def bounds(self, level: float) -> Array:
        """`episode_bounds` (seeds, 2) to ``level``; a diverged seed is known not to reach it."""
        firsts = [seed.first_reaching(level) for seed in self.seeds]
        seen = [
            max(int(seed.episodes[-1]), self.end) if seed.diverged else int(seed.episodes[-1])
            for seed in self.seeds
        ]
        pairs = zip(firsts, seen, strict=True)
        episodes = np.array([last if first is None else first for first, last in pairs], np.float64)
        return episode_bounds(episodes, np.array([first is not None for first in firsts]))

    def count(self, *states: State) -> int:
        """Cells in one of these states."""
        return sum(record.state in states for record in self.records)


@dataclass(frozen=True)
class Problem:
    """What curves of one figure share: the same simulator, horizon, actions and cost.

    Methods and variants may see it differently (observation, exploration) and still be compared.
    """

    title: str
    """the task's name; of a further problem of that name with the variant that makes it one"""
    task: str
    measure: EvaluationSettings
    """of the newest cell"""
    curves: tuple[Curve, ...]
    pending: tuple[CellRecord, ...]
    """cells of configurations that have no value yet"""

    def curve(self, label: str) -> Curve | None:
        """The curve of that label."""
        return next((curve for curve in self.curves if curve.label == label), None)


def problems(store: Store) -> list[Problem]:
    """Everything that the store has evaluated, by task."""
    groups: dict[tuple[str, str], list[CellRecord]] = defaultdict(list)
    for record in store.cells():
        groups[record.cell.task, _problem_key(record.cell)].append(record)
    measures = {
        key: _newest(records).cell.configuration.evaluation for key, records in groups.items()
    }
    evaluations = _evaluations(store, {measure.headline for measure in measures.values()})
    titles = _titles(groups)
    found = [
        _problem(titles[key], records, measures[key], evaluations)
        for key, records in groups.items()
    ]
    return sorted(found, key=lambda problem: problem.title)


Evaluations = dict[tuple[str, str], list[tuple[int, float]]]
"""(cell, measure) -> (episodes, value) in the order of iterations"""


def _evaluations(store: Store, names: Iterable[str]) -> Evaluations:
    found: Evaluations = defaultdict(list)
    rows = store.metrics(names=sorted(names), splits=[EVALUATION_SPLIT])
    for row in sorted(rows, key=lambda row: int(row["iteration"])):
        found[row["cell"], row["name"]].append((row["episodes"], row["value"]))
    return found


def _problem(
    title: str,
    records: Sequence[CellRecord],
    measure: EvaluationSettings,
    evaluations: Evaluations,
) -> Problem:
    groups: dict[tuple[str, str, str], list[CellRecord]] = defaultdict(list)
    for record in records:
        cell = record.cell
        groups[cell.method, cell.variant, _configuration_key(cell)].append(record)
    newest = {
        (method, variant): key
        for (method, variant, key), group in sorted(
            groups.items(), key=lambda item: _newest(item[1]).created
        )
    }
    curves, pending = [], []
    for (method, variant, key), group in sorted(groups.items()):
        seeds = [
            seed
            for record in sorted(group, key=lambda record: record.cell.seed)
            if (seed := seed_curve(record, evaluations[record.hash, measure.headline], measure))
        ]
        if not seeds:
            pending += group
            continue
        label = method if variant == "default" else f"{method}:{variant}"
        if newest[method, variant] != key:
            label += f"@{key[:6]}"
        ordered = tuple(sorted(group, key=lambda record: record.cell.seed))
        curves.append(Curve(label, method, variant, key, measure, ordered, tuple(seeds)))
    return Problem(title, records[0].cell.task, measure, tuple(curves), tuple(pending))


def seed_curve(
    record: CellRecord, evaluations: Sequence[tuple[int, float]], measure: EvaluationSettings
) -> SeedCurve | None:
    """The curve of one cell; None where there is no finite value.

    A value that is not finite counts as divergence, whatever the run made of it: what comes after
    is left out.
    """
    by_count = dict(evaluations)  # of two evaluations at one count the later one stands
    episodes = np.array(sorted(by_count), dtype=np.int64)
    values = np.array([by_count[count] for count in episodes.tolist()], dtype=np.float64)
    broken = ~np.isfinite(values)
    kept = int(broken.argmax()) if broken.any() else len(values)
    if kept == 0:
        return None
    diverged = bool(broken.any()) or record.state is State.DIVERGED
    return SeedCurve(record, episodes[:kept], values[:kept], diverged, measure.better)


def _newest(records: Sequence[CellRecord]) -> CellRecord:
    return max(records, key=lambda record: (record.created, record.hash))


def _configuration_key(cell: Cell) -> str:
    """The same for all seeds of one configuration, and for no other."""
    return Cell(cell.task, cell.method, cell.variant, 0, cell.configuration).hash


def _problem_key(cell: Cell) -> str:
    """Equal where two cells solve the same problem."""
    settings = hashed_values(cell.configuration.task)
    for seen_by_the_method in ("observation", "exploration"):
        settings.pop(seen_by_the_method, None)
    return json.dumps(settings, sort_keys=True)


def _titles(groups: dict[tuple[str, str], list[CellRecord]]) -> dict[tuple[str, str], str]:
    """The newest problem with the default variant has its task's plain name."""
    titles: dict[tuple[str, str], str] = {}
    used: set[str] = set()

    def rank(item: tuple[tuple[str, str], list[CellRecord]]) -> tuple[bool, float]:
        records = item[1]
        default = any(record.cell.variant == "default" for record in records)
        return not default, -_newest(records).created.timestamp()

    for key, records in sorted(groups.items(), key=rank):
        task, cell = key[0], _newest(records).cell
        by_variant = [f"{task}:{cell.variant}"] if cell.variant != "default" else []
        names = [task, *by_variant, f"{task}@{_configuration_key(cell)[:6]}"]
        titles[key] = next(name for name in names if name not in used)
        used.add(titles[key])
    return titles
