"""What the store takes, hands out and raises: plain values, no database behind them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from solar_cli.errors import SolarError
from solar_cli.settings import Cell
from solar_cli.store.owner import Owner

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = [
    "ArtifactRecord",
    "AttemptRecord",
    "CellBusy",
    "CellRecord",
    "CheckpointRecord",
    "Fenced",
    "Metric",
    "Outcome",
    "Owner",
    "Split",
    "State",
]

Split = Literal["train", "noise_free", "model"]
"""What a metric is of: collected episodes, evaluation episodes, or the learner's model."""


class CellBusy(SolarError):
    """Another live process computes this cell."""


class Fenced(SolarError):
    """A write of an attempt that has ended or was taken over; the writer must stop."""


class Outcome(StrEnum):
    """How an attempt ended."""

    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    FAILED = "failed"
    DIVERGED = "diverged"


class State(StrEnum):
    """What a cell is now; derived from its newest attempt whenever it is read."""

    PENDING = "pending"
    RUNNING = "running"
    INTERRUPTED = "interrupted"
    FINISHED = "finished"
    FAILED = "failed"
    DIVERGED = "diverged"


@dataclass(frozen=True)
class Metric:
    """One measured number of one iteration."""

    name: str
    value: float
    """may be nan or infinite"""
    split: Split = "train"
    values: NDArray[np.float64] | None = None
    """one number an episode, shape (N,), where the metric is the mean of an evaluation"""


@dataclass(frozen=True)
class CheckpointRecord:
    """A file that a run can continue from. Checkpoints are ordered by (iteration, position)."""

    path: str
    """below the cell's folder, such as ``checkpoints/3.1-2.pt``; never a path used before"""
    sha256: str
    bytes: int
    iteration: int
    episodes: int
    position: int
    """order within the iteration; the complete one is the last"""
    complete: bool
    """made at the end of the iteration, not inside it"""


@dataclass(frozen=True)
class AttemptRecord:
    """One process's turn at computing a cell. Times are aware, in UTC."""

    number: int
    """1, 2, ...: the newest one alone may write"""
    owner: Owner
    started: datetime
    heartbeat: datetime
    ended: datetime | None
    outcome: Outcome | None
    """``None`` until it ends"""
    error: str | None
    target: int
    """episodes to stop at"""
    activity: str
    """what it is, or was last, doing"""
    fraction: float
    """how much of that is done, 0 to 1"""
    provenance: dict[str, Any]
    """``commit``, ``dirty``, versions, hardware, command"""


@dataclass(frozen=True)
class CellRecord:
    """A cell and how far it is: iteration to seconds are those of its newest commit, 0 at first."""

    cell: Cell
    state: State
    iteration: int
    episodes: int
    steps: int
    """environment steps of those episodes"""
    seconds: float
    """of computing, over all attempts"""
    target: int | None
    """episodes that the newest attempt was to stop at"""
    last_attempt: AttemptRecord | None
    commit: str | None
    """of the newest attempt"""
    dirty: bool
    """whether the newest attempt ran code that is not committed"""
    created: datetime

    @property
    def hash(self) -> str:
        """The cell's name in the store."""
        return self.cell.hash


@dataclass(frozen=True)
class ArtifactRecord:
    """A file for the report; a cell has one of each kind."""

    cell: str
    """hash of the cell"""
    kind: str
    path: Path
    """absolute"""
    sha256: str
    bytes: int
    iteration: int
