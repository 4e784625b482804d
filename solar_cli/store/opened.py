"""An open database: its name, the folder of its cells' files, and who may write."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

from sqlalchemy import select
from sqlalchemy.orm import Session

from solar_cli.errors import UsageError
from solar_cli.store.address import Location
from solar_cli.store.database import Database
from solar_cli.store.records import Fenced
from solar_cli.store.schema import AttemptRow, CellRow


class Opened:
    """What the parts of the store share; a context manager that closes the connections."""

    def __init__(self, location: Location, database: Database) -> None:
        self._location = location
        self._database = database

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __str__(self) -> str:
        """The database for messages, without a password."""
        return str(self._location)

    def close(self) -> None:
        """Close the connections."""
        self._database.close()

    @property
    def address(self) -> str:
        """What opens the same database from any folder; may hold a password."""
        return self._location.address

    @property
    def home(self) -> Path:
        """Folder of all cells' files."""
        return self._location.home

    def folder(self, hash: str) -> Path:
        """Folder of one cell's files; whoever writes there makes it."""
        return self.home / "cells" / hash

    def _newest(self, session: Session, hash: str) -> AttemptRow | None:
        """The cell's newest attempt."""
        return session.scalars(
            select(AttemptRow)
            .where(AttemptRow.cell == hash)
            .order_by(AttemptRow.number.desc())
            .limit(1)
        ).first()

    def _locked(self, session: Session, hash: str) -> CellRow:
        """The cell's row, which no other process can write to until the transaction ends."""
        row = session.get(CellRow, hash, with_for_update=True)
        if row is None:
            raise UsageError(f"no cell {hash!r} in {self}: `solar status` lists those there are")
        return row

    def _writable(self, session: Session, hash: str, attempt: int) -> tuple[CellRow, AttemptRow]:
        """The rows that attempt may write to, its heartbeat renewed; raises `Fenced` otherwise."""
        cell = self._locked(session, hash)
        newest = self._newest(session, hash)
        if newest is None or newest.number != attempt:
            now = "none" if newest is None else f"attempt {newest.number}"
            raise Fenced(f"attempt {attempt} of cell {hash} may not write: {now} has the cell now")
        if newest.ended is not None:
            raise Fenced(f"attempt {attempt} of cell {hash} may not write: it has ended")
        newest.heartbeat = self._database.now(session)
        return cell, newest
