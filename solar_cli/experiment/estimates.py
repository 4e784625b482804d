"""What cells will take, judged by finished cells of the same task, method and variant."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from solar_cli.experiment.matrix import Action, Plan
from solar_cli.settings import Cell
from solar_cli.store.records import CellRecord, State

if TYPE_CHECKING:
    from solar_cli.store.store import Store

WORKER_BYTES = 2**30
"""memory that a worker is counted with: what a cell may take at its peak"""
Kind = tuple[str, str, str]
"""task, method, variant"""


@dataclass(frozen=True)
class Estimate:
    """What a planned cell will take; None where nothing like it was measured."""

    seconds: float | None
    memory_bytes: int
    disk_bytes: int | None


def kind_of(cell: Cell) -> Kind:
    """Cells of one kind differ in their seed only."""
    return cell.task, cell.method, cell.variant


def estimate(store: Store, plans: Sequence[Plan]) -> list[Estimate]:
    """One estimate a plan: the time of the episodes that are missing, the disk of the whole cell.

    A cell that needs no worker takes nothing.
    """
    finished = _finished(store, [plan.cell for plan in plans])
    speeds = {kind: _speed(records) for kind, records in finished.items()}
    sizes = {
        kind: sum(_folder_bytes(store.folder(r.hash)) for r in records) / _episodes(records)
        for kind, records in finished.items()
    }
    return [_estimate(plan, speeds, sizes) for plan in plans]


def measured_speeds(store: Store, cells: Sequence[Cell]) -> dict[Kind, float]:
    """Seconds an episode takes, for those kinds of ``cells`` that have finished ones."""
    return {kind: _speed(records) for kind, records in _finished(store, cells).items()}


def _estimate(plan: Plan, speeds: dict[Kind, float], sizes: dict[Kind, float]) -> Estimate:
    if not plan.is_work:
        return Estimate(0.0, 0, 0)
    kind = kind_of(plan.cell)
    kept = 0 if plan.record is None or plan.action is Action.REDO else plan.record.episodes
    missing = max(0, plan.target - kept)
    seconds = speeds[kind] * missing if kind in speeds else None
    disk = round(sizes[kind] * plan.target) if kind in sizes else None
    return Estimate(seconds, WORKER_BYTES, disk)


def _finished(store: Store, cells: Sequence[Cell]) -> dict[Kind, list[CellRecord]]:
    kinds = {kind_of(cell) for cell in cells}
    records = store.cells(
        tasks={task for task, _, _ in kinds},
        methods={method for _, method, _ in kinds},
        variants={variant for _, _, variant in kinds},
    )
    found: dict[Kind, list[CellRecord]] = defaultdict(list)
    for record in records:
        if record.state is State.FINISHED and record.episodes and kind_of(record.cell) in kinds:
            found[kind_of(record.cell)].append(record)
    return found


def _speed(records: Collection[CellRecord]) -> float:
    return sum(record.seconds for record in records) / _episodes(records)


def _episodes(records: Collection[CellRecord]) -> int:
    return sum(record.episodes for record in records)


def _folder_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
