"""What a run checks before it schedules anything: a mistake is told now, not by a failed cell.

Nothing here imports torch before `require_learners`.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import TYPE_CHECKING

from solar_cli.errors import SolarError, UsageError, nearest

if TYPE_CHECKING:
    from solar_cli.settings import Cell
    from solar_cli.store.store import Store


class Device(StrEnum):
    """Where tensors live."""

    AUTO = "auto"
    CPU = "cpu"
    CUDA = "cuda"


def require_free_label(store: Store, cells: Sequence[Cell], label: str | None) -> None:
    """Raise `UsageError` where ``label`` names another stored configuration of the same task,
    method and seed: two configurations of one name could not be told apart."""
    own = [cell for cell in cells if label is not None and cell.variant == label]
    if not own or label is None:
        return
    hashes: dict[tuple[str, str, int], list[str]] = {}
    for record in store.cells(variants=[label]):
        cell = record.cell
        hashes.setdefault((cell.task, cell.method, cell.seed), []).append(record.hash)
    for cell in own:
        taken = hashes.get((cell.task, cell.method, cell.seed), [])
        if taken and cell.hash not in taken:
            raise UsageError(
                f"--label {label!r}: {cell.title} is stored with other settings "
                f"({taken[0][:8]}): choose another label, or remove that: solar rm {taken[0][:8]}"
            )


def require_memory(cells: Sequence[Cell]) -> None:
    """Raise `UsageError` where a cell cannot fit into this machine, whatever runs beside it."""
    from solar_cli.experiment.estimates import memory_needs
    from solar_cli.experiment.provenance import memory_bytes

    installed = memory_bytes("MemTotal")
    for cell in _distinct(cells):
        needs = memory_needs(cell)
        needed = sum(need.bytes for need in needs)
        if installed is not None and needed > installed:
            largest = max(needs, key=lambda need: need.bytes)
            raise UsageError(
                f"{cell.task}/{cell.method}: takes at least {_gibibytes(needed)} of memory "
                f"({largest.what}: {_gibibytes(largest.bytes)}), this machine has "
                f"{_gibibytes(installed)}: lower {' or '.join(largest.settings)}"
            )


def require_tasks(cells: Sequence[Cell]) -> None:
    """Raise `UsageError` where a task cannot be built, or has not the measure that judges it."""
    from solar_cli.envs import build_task
    from solar_cli.streams import Streams

    for cell in _distinct(cells):
        task, headline = build_task(cell.configuration.task), cell.configuration.evaluation.headline
        task.reset([Streams(0).generator("preflight")])
        names = [f"{kind}_{name}" for name in task.measures() for kind in ("final", "mean")]
        if headline not in (known := ["return", *names]):
            raise UsageError(
                f"task {cell.task!r}: evaluation.headline: no measure is named {headline!r}: "
                f"{nearest(headline, known)}"
            )


def require_device(device: Device) -> None:
    """Raise `UsageError` where the device that was asked for is missing."""
    if device is not Device.CUDA:
        return
    import torch

    if not torch.cuda.is_available():
        raise UsageError(
            "--device cuda: torch sees no GPU here; use --device cpu, or install a CUDA build"
        )


def require_learners(cells: Sequence[Cell]) -> None:
    """Raise `UsageError` where a learner cannot be made, as of layers that do not fit."""
    from solar_cli.settings.registry import load, method
    from solar_cli.streams import Streams

    for cell in _distinct(cells):
        settings, task = cell.configuration.method, cell.configuration.task
        try:
            learner = load(method(cell.method).learner)
            learner(settings, task, Streams(0), "cpu", lambda activity, fraction: None)
        except SolarError as error:
            raise UsageError(f"{cell.task}/{cell.method}: {error}") from error
        except Exception as error:  # of another package's learner
            raise UsageError(
                f"{cell.task}/{cell.method}: its learner cannot be made "
                f"({type(error).__name__}: {error}); correct the method's settings"
            ) from error


def _gibibytes(size: int) -> str:
    return f"{size / 2**30:.1f} GiB"


def _distinct(cells: Sequence[Cell]) -> list[Cell]:
    """One cell of each configuration."""
    return list({(cell.method, str(cell.config())): cell for cell in cells}.values())
