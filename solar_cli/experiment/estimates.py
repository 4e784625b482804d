"""What cells will take: judged by finished cells of the same task, method and variant, and by size.

`memory_needs` counts arrays that no run of a cell can do without, from its settings alone.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from solar_cli.experiment.matrix import Action, Plan
from solar_cli.settings import Cell
from solar_cli.settings.global_mpc import GlobalMpc
from solar_cli.settings.local import LatentMethod, LocalControl, StateMethod
from solar_cli.settings.mpc_nn import MpcNn
from solar_cli.settings.on_policy import OnPolicy
from solar_cli.settings.pixel_mpc import PixelMpc
from solar_cli.settings.schema import Settings
from solar_cli.store.records import CellRecord, State
from solar_cli.store.results import EPISODES

if TYPE_CHECKING:
    from solar_cli.store.store import Store

WORKER_BYTES = 2 * 2**30
"""memory that a worker is counted with: what a cell may take at its peak"""
FLOAT_BYTES = 8
COST_FITS = 5  # whose moments are held at one time: of four folds, and of all
Kind = tuple[str, str, str]
"""task, method, variant"""


@dataclass(frozen=True)
class Estimate:
    """What a planned cell will take; None where nothing like it was measured."""

    seconds: float | None
    memory_bytes: int
    disk_bytes: int | None


@dataclass(frozen=True)
class Need:
    """Arrays that a cell holds in memory, whatever else it does."""

    bytes: int
    what: str
    settings: tuple[str, ...]
    """paths of those that make it large"""


def memory_needs(cell: Cell) -> list[Need]:
    """What a worker holds at one time, at least: a lower bound, made of the cell's settings.

    Episodes of the last evaluation and of the first batch; of a local method a minibatch's frames,
    for each time step a matrix over states and moments of what a quadratic of latents is made of,
    and the weights of all pairs of time steps that posterior inference uses; of a planner the
    action sequences that it draws for one episode; of a method on policy the windows of a rollout.
    """
    task, method = cell.configuration.task, cell.configuration.method
    judged = cell.configuration.evaluation.episodes
    seen, frames = task.observation, task.horizon + 1
    frame = math.prod(seen.frame_shape) * (1 if seen.kind == "image" else 4)  # uint8, float32
    # Actions, what they would have been without noise, and a cost.
    episode = frames * frame + task.horizon * (2 * task.action.size + 1) * FLOAT_BYTES
    sizes = ("task.horizon", "task.observation")
    needs = [Need(judged * episode, "an evaluation", ("evaluation.episodes", *sizes))]
    prefix = f"methods.{cell.method}"
    if isinstance(method, StateMethod):
        batch, batches = max(method.batches.initial, method.batches.noisy), f"{prefix}.batches"
        needs.append(Need(batch * episode, "a batch of episodes", (batches, *sizes)))
    if isinstance(method, LatentMethod):
        training = method.training
        drawn = training.segments * min(training.length, frames) * frame
        longest = (f"{prefix}.training.segments", f"{prefix}.training.length", "task.observation")
        needs.append(Need(drawn, "a minibatch of segments", longest))
    if isinstance(method, LocalControl):
        size = "representation.latent" if isinstance(method, LatentMethod) else "components"
        long, latents = (f"{prefix}.{size}", "task.horizon"), method.latents(seen)
        matrices = task.horizon * (latents * seen.window) ** 2 * FLOAT_BYTES
        needs.append(Need(matrices, "dynamics of latent states", long))
        monomials = (latents + 1) * (latents + 2) // 2  # of a quadratic
        moments = COST_FITS * task.horizon * monomials**2 * FLOAT_BYTES
        needs.append(Need(moments, "moments of the cost fit", long))
        if method.local_fit.method == "posterior":
            pairs = task.horizon**2 * FLOAT_BYTES
            needs.append(Need(pairs, "weights of neighbouring time steps", ("task.horizon",)))
    planner = _planner(method)
    if planner is not None:
        name, samples, ahead = planner
        drawn = samples * ahead * task.action.size * 4  # float32
        long = (f"{prefix}.{name}.samples", f"{prefix}.{name}.horizon")
        needs.append(Need(drawn, "action sequences of a plan", long))
    if isinstance(method, OnPolicy):
        every = method.rollout * (episode + task.horizon * seen.window * frame)
        named = (f"{prefix}.rollout", *sizes)
        needs.append(Need(every, "a rollout with all its windows", named))
    return needs


def _planner(method: Settings) -> tuple[str, int, int] | None:
    """Name of a planner's settings, action sequences that it draws, and steps ahead."""
    if isinstance(method, GlobalMpc | PixelMpc):
        return "planner", method.planner.samples, method.planner.horizon
    if isinstance(method, MpcNn):
        return "shooting", method.shooting.samples, method.shooting.horizon
    return None


def kind_of(cell: Cell) -> Kind:
    """Cells of one kind differ in their seed only."""
    return cell.task, cell.method, cell.variant


def estimate(store: Store, plans: Sequence[Plan]) -> list[Estimate]:
    """One estimate a plan: the time of the episodes that are missing, the disk of the whole cell.

    A cell that needs no worker takes nothing.
    """
    finished = _finished(store, [plan.cell for plan in plans])
    speeds = {kind: _speed(records) for kind, records in finished.items()}
    sizes = {kind: _size(store, records) for kind, records in finished.items()}
    return [_estimate(plan, speeds, sizes) for plan in plans]


def measured_speeds(store: Store, cells: Sequence[Cell]) -> dict[Kind, float]:
    """Seconds an episode takes, for those kinds of ``cells`` that have finished ones."""
    return {kind: _speed(records) for kind, records in _finished(store, cells).items()}


def _estimate(plan: Plan, speeds: dict[Kind, float], sizes: dict[Kind, _Size]) -> Estimate:
    if not plan.is_work:
        return Estimate(0.0, 0, 0)
    kind = kind_of(plan.cell)
    kept = 0 if plan.record is None or plan.action is Action.REDO else plan.record.episodes
    missing = max(0, plan.target - kept)
    seconds = speeds[kind] * missing if kind in speeds else None
    disk = sizes[kind].at(plan.target) if kind in sizes else None
    memory = sum(need.bytes for need in memory_needs(plan.cell))
    return Estimate(seconds, max(WORKER_BYTES, memory), disk)


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


@dataclass(frozen=True)
class _Size:
    """Bytes of a cell's files."""

    an_episode: float
    rest: float

    def at(self, episodes: int) -> int:
        return round(self.rest + self.an_episode * episodes)


def _size(store: Store, records: Collection[CellRecord]) -> _Size:
    folders = [store.folder(record.hash) for record in records]
    kept = sum(_folder_bytes(folder / EPISODES) for folder in folders)
    rest = sum(map(_folder_bytes, folders)) - kept
    return _Size(kept / _episodes(records), rest / len(records))


def _speed(records: Collection[CellRecord]) -> float:
    return sum(record.seconds for record in records) / _episodes(records)


def _episodes(records: Collection[CellRecord]) -> int:
    return sum(record.episodes for record in records)


def _folder_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
