"""The table of results: final performance, its intervals, and the episodes to each level."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from solar_cli.reporting.curves import Curve, Problem
from solar_cli.reporting.evidence import codes, notes
from solar_cli.reporting.statistics import (
    Bounded,
    Interval,
    iqm,
    iqm_interval,
    typical_episodes,
)
from solar_cli.reporting.tables import Table, bounded, interval, number
from solar_cli.reporting.timing import note, shares
from solar_cli.store.records import State
from solar_cli.store.store import Store
from solar_cli.wording import counted

INTERVALS = "Intervals are 95 % stratified bootstrap intervals over seeds."
COVERS = (
    "Below ten seeds they are too short: 'covers' is the share of such intervals that held the "
    "truth when measured on synthetic data, at worst."
)
LEVEL_NOTE = (
    "Episodes to a level: median over seeds of the first evaluation that reaches it, with the "
    "seeds that did; a seed that never did enters as a lower bound (>)."
)


@dataclass(frozen=True)
class LevelResult:
    """Episodes to reach one level."""

    level: float
    episodes: Bounded
    """median over seeds"""
    reached: int
    """seeds that reached it"""


@dataclass(frozen=True)
class Summary:
    """One curve in numbers."""

    label: str
    method: str
    variant: str
    configuration: str
    seeds: int
    """with a value"""
    diverged: int
    failed: int
    unfinished: int
    episodes: int
    """at the end of the curve, where the numbers are taken"""
    mean: float
    std: float | None
    """over seeds; None for one"""
    iqm: float
    interval: Interval | None
    """of the IQM"""
    levels: tuple[LevelResult, ...]
    seconds: float
    """of computing, mean over seeds"""
    memory_bytes: float | None
    """largest peak of a seed, where it was measured"""
    codes: tuple[str, ...]
    notes: tuple[str, ...]


def summarise(
    store: Store, curve: Curve, present: Mapping[str, Any], memory: Mapping[str, float]
) -> Summary:
    """The numbers of a curve; ``memory`` has the peak of each cell that measured it, in bytes."""
    bounds = {level: curve.bounds(level) for level in curve.measure.levels}
    peaks = [memory[record.hash] for record in curve.records if record.hash in memory]
    return Summary(
        label=curve.label,
        method=curve.method,
        variant=curve.variant,
        configuration=curve.key,
        seeds=len(curve.seeds),
        diverged=sum(seed.diverged for seed in curve.seeds),
        failed=curve.count(State.FAILED),
        unfinished=curve.count(State.PENDING, State.RUNNING, State.INTERRUPTED),
        episodes=curve.end,
        mean=float(curve.mean[-1]),
        std=curve.final_std,
        iqm=float(iqm(curve.final)),
        interval=iqm_interval(curve.final),
        levels=tuple(
            LevelResult(level, typical_episodes(both), int((both[:, 0] == both[:, 1]).sum()))
            for level, both in bounds.items()
        ),
        seconds=sum(seed.record.seconds for seed in curve.seeds) / len(curve.seeds),
        memory_bytes=max(peaks, default=None),
        codes=tuple(codes(store, curve)),
        notes=(
            *notes(store, curve, present),
            *note(curve.label, shares(store, [seed.record for seed in curve.seeds])),
        ),
    )


def table(problem: Problem, summaries: list[Summary]) -> Table:
    """The results of one problem as text."""
    measure = problem.measure
    columns = [
        "method",
        "seeds",
        "episodes",
        f"{title(measure.headline, measure.unit, measure.better)}, mean ± std",
        "IQM, 95 % interval",
        *(f"episodes to {number(level)}" for level in measure.levels),
        "time a seed",
    ]
    if measured := any(summary.memory_bytes is not None for summary in summaries):
        columns.append("peak memory")
    rows = []
    for summary in summaries:
        row = [
            summary.label,
            seeds(summary),
            str(summary.episodes),
            mean_and_spread(summary),
            f"{number(summary.iqm)} {interval(summary.interval)}",
            *(
                f"{bounded(level.episodes)} ({level.reached}/{summary.seeds})"
                for level in summary.levels
            ),
            duration(summary.seconds),
        ]
        if measured:
            peak = summary.memory_bytes
            row.append("-" if peak is None else f"{peak / 2**20:.0f} MiB")
        rows.append(tuple(row))
    said = [note for summary in summaries for note in summary.notes]
    said += caveats(summary.interval for summary in summaries)
    said += [LEVEL_NOTE] * bool(measure.levels)
    return Table(tuple(columns), tuple(rows), tuple(said))


def caveats(intervals: Iterable[Interval | None]) -> list[str]:
    """What to know of the intervals that are shown; nothing where there is none."""
    shown = [one for one in intervals if one is not None]
    if not shown:
        return []
    covers = any(one.coverage is not None for one in shown)
    return [f"{INTERVALS} {COVERS}" if covers else INTERVALS]


def mean_and_spread(summary: Summary) -> str:
    """``0.3 ± 0.1``; of a single seed, which has no spread, ``0.3 ± –``."""
    return f"{number(summary.mean)} ± {'–' if summary.std is None else number(summary.std)}"


def title(measure: str, unit: str, better: str) -> str:
    """``final distance (world units, lower is better)``."""
    return f"{measure.replace('_', ' ')} ({f'{unit}, ' if unit else ''}{better} is better)"


def seeds(summary: Summary) -> str:
    """``10``, or ``10 (1 diverged, 2 failed)``."""
    counts = {
        "diverged": summary.diverged,
        "failed": summary.failed,
        "unfinished": summary.unfinished,
    }
    extra = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    return f"{summary.seeds} ({extra})" if extra else str(summary.seeds)


def duration(seconds: float) -> str:
    """``45 s``, ``12 min`` or ``3.5 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def line(problem: Problem, summary: Summary) -> str:
    """The headline of one curve in one line."""
    measure = problem.measure
    unit = f" {measure.unit}" if measure.unit else ""
    return (
        f"{problem.title} {summary.label}: {measure.headline} {mean_and_spread(summary)}"
        f"{unit} after {counted(summary.episodes, 'episode')}, seeds: {seeds(summary)}, "
        f"code: {', '.join(summary.codes) or 'unknown'}"
    )


def flat(problem: Problem, summary: Summary) -> dict[str, Any]:
    """One row of numbers for a spreadsheet."""
    shown = summary.interval
    row: dict[str, Any] = {"problem": problem.title, "measure": problem.measure.headline}
    row |= {
        name: value
        for name, value in asdict(summary).items()
        if name not in ("interval", "levels", "codes", "notes")
    }
    row["iqm_low"] = shown.low if shown else None
    row["iqm_high"] = shown.high if shown else None
    row["iqm_coverage"] = shown.coverage if shown else None
    for level in summary.levels:
        name = f"episodes_to_{number(level.level)}"
        row[f"{name}_low"] = level.episodes.low
        row[f"{name}_high"] = level.episodes.high
        row[f"{name}_reached"] = level.reached
    row["code"] = "; ".join(summary.codes)
    return row
