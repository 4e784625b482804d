"""The tables. ``docs/schema.md`` is made from the migrations and from what is said here.

A change of a table is a new migration in ``migrations/versions`` and a new last entry of
`VERSIONS`; a test compares the migrated tables with these classes on every kind of database.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    DateTime,
    Dialect,
    Double,
    ForeignKey,
    LargeBinary,
    Text,
    TypeDecorator,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

PREFIX = "solar_"
"""Revisions start with it, which tells a newer database of ours from somebody else's."""
VERSIONS = ("solar_0001",)
"""Revisions of the schema, oldest first. Opening a current database needs no alembic for this."""
HEAD = VERSIONS[-1]


class Moment(TypeDecorator[datetime]):
    """An aware time in UTC; SQLite, which has no time zones, stores its UTC digits."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """To the database."""
        if value is None or dialect.name != "sqlite":
            return value
        return value.astimezone(UTC).replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """From the database."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class Base(DeclarativeBase):
    """All tables."""

    type_annotation_map = {  # noqa: RUF012
        str: Text,
        int: BigInteger,
        float: Double,
        bytes: LargeBinary,
        datetime: Moment,
        dict[str, Any]: JSON,
    }


def _cell_key() -> Mapped[str]:
    return mapped_column(
        ForeignKey("cell.hash", ondelete="CASCADE"), primary_key=True, doc="hash of the cell"
    )


class CellRow(Base):
    """What a run computes: task x method x variant x seed, and how far it is."""

    __tablename__ = "cell"

    hash: Mapped[str] = mapped_column(primary_key=True, doc="16 hexadecimal digits")
    task: Mapped[str] = mapped_column(doc="name of the task's card")
    method: Mapped[str] = mapped_column(doc="name of the method")
    variant: Mapped[str] = mapped_column(doc="name of the overrides of the card; default if none")
    seed: Mapped[int] = mapped_column(doc="of all random streams")
    configuration: Mapped[str] = mapped_column(
        doc="JSON of every resolved setting: tables task, evaluation, method"
    )
    created: Mapped[datetime] = mapped_column(doc="when it was first asked for (UTC)")
    iteration: Mapped[int] = mapped_column(default=0, doc="of the newest commit")
    episodes: Mapped[int] = mapped_column(default=0, doc="collected up to the newest commit")
    steps: Mapped[int] = mapped_column(default=0, doc="environment steps of those episodes")
    simulated_seconds: Mapped[float] = mapped_column(
        default=0.0, doc="simulated time of those steps, in seconds"
    )
    seconds: Mapped[float] = mapped_column(
        default=0.0, doc="of computing up to the newest commit, over all attempts"
    )


class AttemptRow(Base):
    """One process's turn at computing a cell; only the newest, not ended, may write."""

    __tablename__ = "attempt"

    cell: Mapped[str] = _cell_key()
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False, doc="1, 2, ...")
    host: Mapped[str] = mapped_column(doc="machine of the owning process")
    pid: Mapped[int] = mapped_column(doc="id of the owning process")
    process_start: Mapped[float] = mapped_column(
        doc="when the owning process started, in seconds since boot"
    )
    boot: Mapped[str] = mapped_column(
        doc="boot of the machine and namespace of process ids; empty where unknown"
    )
    started: Mapped[datetime] = mapped_column(doc="when the cell was claimed (UTC)")
    heartbeat: Mapped[datetime] = mapped_column(doc="last sign of life (UTC)")
    ended: Mapped[datetime | None] = mapped_column(doc="null while it runs (UTC)")
    outcome: Mapped[str | None] = mapped_column(
        doc="finished, interrupted, failed or diverged; null while it runs"
    )
    error: Mapped[str | None] = mapped_column(doc="why it did not finish")
    target: Mapped[int] = mapped_column(doc="episodes to stop at")
    activity: Mapped[str] = mapped_column(default="", doc="what it is, or was last, doing")
    fraction: Mapped[float] = mapped_column(default=0.0, doc="how much of that is done, 0 to 1")
    provenance: Mapped[dict[str, Any]] = mapped_column(
        doc="commit, dirty, versions, hardware, command"
    )


class MetricRow(Base):
    """One measured number of one iteration of a cell."""

    __tablename__ = "metric"

    cell: Mapped[str] = _cell_key()
    iteration: Mapped[int] = mapped_column(
        primary_key=True, autoincrement=False, doc="0 is the initial policy"
    )
    split: Mapped[str] = mapped_column(
        primary_key=True,
        doc="of what: train (collected episodes), noise_free (evaluation episodes) or model",
    )
    name: Mapped[str] = mapped_column(primary_key=True, doc="such as final_distance")
    attempt: Mapped[int] = mapped_column(doc="number of the attempt that measured it")
    episodes: Mapped[int] = mapped_column(doc="collected up to this iteration")
    steps: Mapped[int] = mapped_column(doc="environment steps of those episodes")
    simulated_seconds: Mapped[float] = mapped_column(doc="simulated time of those steps")
    seconds: Mapped[float] = mapped_column(doc="of computing up to here, over all attempts")
    value: Mapped[float | None] = mapped_column(doc="null when it is not finite")
    kind: Mapped[str] = mapped_column(doc="finite, nan, +inf or -inf")
    episode_values: Mapped[bytes | None] = mapped_column(
        doc="one little-endian float64 an episode of an evaluation, whose mean the value is"
    )


class CheckpointRow(Base):
    """A file that the run can continue from."""

    __tablename__ = "checkpoint"

    cell: Mapped[str] = _cell_key()
    iteration: Mapped[int] = mapped_column(primary_key=True, autoincrement=False, doc="made in it")
    position: Mapped[int] = mapped_column(
        primary_key=True, autoincrement=False, doc="order within the iteration"
    )
    complete: Mapped[bool] = mapped_column(doc="made at the end of the iteration, not inside it")
    attempt: Mapped[int] = mapped_column(doc="number of the attempt that made it")
    episodes: Mapped[int] = mapped_column(doc="collected up to here")
    path: Mapped[str] = mapped_column(doc="below the cell's folder")
    sha256: Mapped[str] = mapped_column(doc="of the file, in hexadecimal")
    bytes: Mapped[int] = mapped_column(doc="size of the file")
    created: Mapped[datetime] = mapped_column(doc="when it was committed (UTC)")


class ArtifactRow(Base):
    """A file for the report; a newer one of the same kind replaces it."""

    __tablename__ = "artifact"

    cell: Mapped[str] = _cell_key()
    kind: Mapped[str] = mapped_column(primary_key=True, doc="such as animation")
    iteration: Mapped[int] = mapped_column(doc="whose policy or model it shows")
    attempt: Mapped[int] = mapped_column(doc="number of the attempt that made it")
    path: Mapped[str] = mapped_column(doc="below the cell's folder")
    sha256: Mapped[str] = mapped_column(doc="of the file, in hexadecimal")
    bytes: Mapped[int] = mapped_column(doc="size of the file")
    created: Mapped[datetime] = mapped_column(doc="when it was stored (UTC)")
