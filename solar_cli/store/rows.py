"""Between rows and records: what a cell is now, stored settings, numbers that are not finite.

numpy is imported where there are arrays: to see that a matrix is finished takes none.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, fields
from datetime import datetime, timedelta
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from pydantic import ConfigDict, ValidationError

from solar_cli.errors import SolarError
from solar_cli.settings import Cell, Configuration, EvaluationSettings, TaskSettings, restore
from solar_cli.settings.registry import method, settings_class
from solar_cli.settings.schema import Settings
from solar_cli.store.owner import Owner, is_alive
from solar_cli.store.records import (
    AttemptRecord,
    CellRecord,
    CheckpointRecord,
    Metric,
    Outcome,
    State,
)
from solar_cli.store.schema import AttemptRow, CellRow, CheckpointRow

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LEASE = timedelta(seconds=60)
"""A process that cannot be looked up counts as gone when its last heartbeat is older."""
LITTLE_ENDIAN = "<f8"
NOT_FINITE = {"nan": math.nan, "+inf": math.inf, "-inf": -math.inf}


class Stored(Settings):
    """Settings whose model is not installed or has changed: as they were stored, unchecked."""

    model_config = ConfigDict(extra="allow")


def restored(row: CellRow) -> Cell:
    """The cell of a row. It keeps the hash that it was stored under, whatever became of its
    settings' models, and it can be read when the package of its method is gone.
    """
    configuration = _configuration(row.method, row.configuration)
    cell = Cell(row.task, row.method, row.variant, row.seed, configuration)
    cell.__dict__["hash"] = row.hash  # where the cached property keeps it
    return cell


@lru_cache(maxsize=256)
def _configuration(method_name: str, text: str) -> Configuration:
    """A stored configuration; the seeds of one variant share one, and it is validated once."""
    config = json.loads(text)
    try:
        return restore("", method_name, "", 0, config).configuration
    except (SolarError, ImportError, AttributeError, ValidationError):
        parts = {
            "task": _settings(lambda: TaskSettings, config["task"]),
            "evaluation": _settings(lambda: EvaluationSettings, config["evaluation"]),
            "method": _settings(lambda: settings_class(method(method_name)), config["method"]),
        }
        return Configuration.model_construct(None, **parts)


def _settings(model: Callable[[], type[Settings]], values: dict[str, Any]) -> Settings:
    try:
        return model().model_validate(values)
    except (SolarError, ImportError, AttributeError, ValidationError):
        return Stored.model_validate(values)


def is_running(attempt: AttemptRow | None, now: datetime) -> bool:
    """Whether an attempt has not ended and its process lives: looked up, else by its lease."""
    if attempt is None or attempt.ended is not None:
        return False
    alive = is_alive(owner_of(attempt))
    return now - attempt.heartbeat <= LEASE if alive is None else alive


def state_of(attempt: AttemptRow | None, now: datetime) -> State:
    """What a cell with this newest attempt is now."""
    if attempt is None:
        return State.PENDING
    if attempt.outcome is not None:
        return State(attempt.outcome)
    return State.RUNNING if is_running(attempt, now) else State.INTERRUPTED


def owner_of(row: AttemptRow) -> Owner:
    """The process that made an attempt."""
    return Owner(row.host, row.pid, row.process_start, row.boot)


def cell_record(row: CellRow, newest: AttemptRow | None, now: datetime) -> CellRecord:
    """The record of a cell and its newest attempt."""
    attempt = None if newest is None else attempt_record(newest)
    provenance = {} if attempt is None else attempt.provenance
    return CellRecord(
        cell=restored(row),
        state=state_of(newest, now),
        iteration=row.iteration,
        episodes=row.episodes,
        steps=row.steps,
        seconds=row.seconds,
        target=None if attempt is None else attempt.target,
        last_attempt=attempt,
        commit=provenance.get("commit"),
        dirty=bool(provenance.get("dirty")),
        created=row.created,
    )


def attempt_record(row: AttemptRow) -> AttemptRecord:
    """The record of an attempt."""
    return AttemptRecord(
        number=row.number,
        owner=owner_of(row),
        started=row.started,
        heartbeat=row.heartbeat,
        ended=row.ended,
        outcome=None if row.outcome is None else Outcome(row.outcome),
        error=row.error,
        target=row.target,
        activity=row.activity,
        fraction=row.fraction,
        provenance=row.provenance,
    )


def checkpoint_record(row: CheckpointRow) -> CheckpointRecord:
    """The record of a checkpoint."""
    return CheckpointRecord(
        **{field.name: getattr(row, field.name) for field in fields(CheckpointRecord)}
    )


def checkpoint_row(
    cell: str, attempt: int, checkpoint: CheckpointRecord, now: datetime
) -> CheckpointRow:
    """The row of a checkpoint that is committed ``now``."""
    return CheckpointRow(cell=cell, attempt=attempt, created=now, **asdict(checkpoint))


def metric_columns(metric: Metric) -> dict[str, Any]:
    """The columns that hold a metric's number; databases differ on nan, so it has a kind."""
    kind = kind_of(metric.value)
    values = metric.values
    return {
        "split": metric.split,
        "name": metric.name,
        "kind": kind,
        "value": float(metric.value) if kind == "finite" else None,
        "episode_values": None if values is None else values.astype(LITTLE_ENDIAN).tobytes(),
    }


def kind_of(value: float) -> str:
    """``finite``, ``nan``, ``+inf`` or ``-inf``."""
    if math.isfinite(value):
        return "finite"
    return "nan" if math.isnan(value) else f"{value:+}"


def number(value: float | None, kind: str) -> float:
    """The number that `metric_columns` took apart."""
    return NOT_FINITE[kind] if value is None else value


def array(values: bytes | None) -> NDArray[np.float64] | None:
    """One number an episode, shape (N,)."""
    if values is None:
        return None
    import numpy as np

    return np.frombuffer(values, LITTLE_ENDIAN).astype(np.float64)


def plain(text: str) -> str:
    """Text that every database stores: without NUL characters and lone surrogates."""
    return text.replace("\0", "\N{REPLACEMENT CHARACTER}").encode(errors="replace").decode()
