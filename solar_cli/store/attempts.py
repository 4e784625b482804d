"""The attempts at cells: which process computes a cell, and how it ended."""

from __future__ import annotations

from typing import Any

from sqlalchemy import select

from solar_cli.store import rows
from solar_cli.store.opened import Opened
from solar_cli.store.records import AttemptRecord, CellBusy, Outcome, Owner
from solar_cli.store.schema import AttemptRow


class Attempts(Opened):
    """Who may write the results of a cell."""

    def claim(self, hash: str, owner: Owner, target: int, provenance: dict[str, Any]) -> int:
        """Begin an attempt to compute a cell up to ``target`` episodes, and return its number.

        A cell that another process left is taken over, that attempt ending ``interrupted``: at
        once when the process can be looked up and is gone, else when its last heartbeat is older
        than the lease. Raises `CellBusy` when it lives.
        """
        with self._database.writing() as session:
            self._locked(session, hash)
            newest = self._newest(session, hash)
            now = self._database.now(session)
            if newest is not None and newest.ended is None:
                who = f"process {newest.pid} on {newest.host}"
                if rows.is_running(newest, now):
                    raise CellBusy(f"cell {hash} is being computed by {who}: wait, or stop it")
                newest.ended = newest.heartbeat
                newest.outcome = Outcome.INTERRUPTED.value
                newest.error = f"{who} is gone"
            number = 1 if newest is None else newest.number + 1
            session.add(
                AttemptRow(
                    cell=hash,
                    number=number,
                    host=owner.host,
                    pid=owner.pid,
                    process_start=owner.process_start,
                    boot=owner.boot,
                    started=now,
                    heartbeat=now,
                    target=target,
                    provenance=provenance,
                )
            )
            return number

    def beat(self, hash: str, attempt: int, activity: str, fraction: float) -> None:
        """A sign of life and of progress. Raises `Fenced`."""
        with self._database.writing() as session:
            _, row = self._writable(session, hash, attempt)
            row.activity = rows.plain(activity)
            row.fraction = fraction

    def end(self, hash: str, attempt: int, outcome: Outcome, error: str | None = None) -> None:
        """End an attempt; ``error`` says why it did not finish. Raises `Fenced`."""
        with self._database.writing() as session:
            _, row = self._writable(session, hash, attempt)
            row.ended = row.heartbeat
            row.outcome = outcome.value
            row.error = None if error is None else rows.plain(error)

    def attempts(self, hash: str) -> list[AttemptRecord]:
        """All attempts at a cell, oldest first."""
        with self._database.reading() as session:
            found = session.scalars(
                select(AttemptRow).where(AttemptRow.cell == hash).order_by(AttemptRow.number)
            )
            return [rows.attempt_record(row) for row in found]
