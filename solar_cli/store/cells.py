"""The cells of a store: added, listed, found, removed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Iterable, Sequence
from typing import Any

from sqlalchemy import ColumnElement, delete, func, select, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

from solar_cli.errors import SolarError, UsageError, nearest
from solar_cli.settings import Cell
from solar_cli.store import rows
from solar_cli.store.opened import Opened
from solar_cli.store.records import CellRecord
from solar_cli.store.schema import AttemptRow, CellRow


class Cells(Opened):
    """What is to be computed, and how far it is."""

    def add(self, cells: Iterable[Cell]) -> None:
        """Store what is to be computed. A cell that is there already stays as it is."""
        wanted = {cell.hash: cell for cell in cells}
        with self._database.writing() as session:
            self._database.serialise(session)
            known = set(session.scalars(select(CellRow.hash).where(CellRow.hash.in_(wanted))))
            now = self._database.now(session)
            session.add_all(
                CellRow(
                    hash=hash,
                    task=cell.task,
                    method=cell.method,
                    variant=cell.variant,
                    seed=cell.seed,
                    configuration=json.dumps(cell.config()),
                    created=now,
                )
                for hash, cell in wanted.items()
                if hash not in known
            )

    def cells(
        self,
        *,
        tasks: Collection[str] = (),
        methods: Collection[str] = (),
        variants: Collection[str] = (),
        seeds: Collection[int] = (),
        hashes: Collection[str] = (),
    ) -> list[CellRecord]:
        """Cells by task, method, variant and seed; an empty collection leaves that open."""
        wanted = chosen(tasks, methods, variants, seeds, hashes)
        with self._database.reading() as session:
            return self._records(session, wanted)

    def find(self, prefix: str) -> CellRecord:
        """The cell whose hash starts with ``prefix``. Raises `UsageError` for none and several."""
        with self._database.reading() as session:
            starts = CellRow.hash.startswith(prefix.lower(), autoescape=True)
            found = self._records(session, [starts])
            if len(found) == 1:
                return found[0]
            known = session.scalars(select(CellRow.hash)).all()
        if not found:
            raise UsageError(f"no cell {prefix!r} in {self}: {nearest(prefix, known)}")
        listed = "; ".join(f"{record.hash} ({record.cell.title})" for record in found[:5])
        raise UsageError(f"cell {prefix!r} is one of {len(found)}: {listed}: give more digits")

    def remove(self, hashes: Collection[str]) -> None:
        """Delete cells with all that is stored of them, rows first, then files.

        Raises `SolarError`, and deletes nothing, when a process computes one of them.
        """
        with self._database.writing() as session:
            for hash in sorted(
                hashes
            ):  # in one order, so that two removals cannot block each other
                self._locked(session, hash)
                newest = self._newest(session, hash)
                if newest is not None and rows.is_running(newest, self._database.now(session)):
                    raise SolarError(
                        f"cell {hash} is running ({newest.host}, process {newest.pid}): "
                        "stop it first; nothing was removed"
                    )
            session.execute(delete(CellRow).where(CellRow.hash.in_(hashes)))
        for hash in hashes:
            try:
                shutil.rmtree(self.folder(hash))
            except FileNotFoundError:
                pass
            except OSError as error:
                raise SolarError(
                    f"cell {hash} is removed, but not its files ({error}): delete "
                    f"{self.folder(hash)}"
                ) from error

    def _records(self, session: Session, wanted: Sequence[ColumnElement[bool]]) -> list[CellRecord]:
        """The cells for which all of ``wanted`` holds, sorted as a person lists them."""
        found = session.scalars(
            select(CellRow)
            .where(*wanted)
            .order_by(CellRow.task, CellRow.method, CellRow.variant, CellRow.seed, CellRow.hash)
        ).all()
        last = select(AttemptRow.cell, func.max(AttemptRow.number)).group_by(AttemptRow.cell)
        newest = {
            row.cell: row
            for row in session.scalars(
                select(AttemptRow)
                .join(CellRow, CellRow.hash == AttemptRow.cell)
                .where(tuple_(AttemptRow.cell, AttemptRow.number).in_(last), *wanted)
            )
        }
        now = self._database.now(session)
        return [rows.cell_record(row, newest.get(row.hash), now) for row in found]


def chosen(
    tasks: Collection[str],
    methods: Collection[str],
    variants: Collection[str],
    seeds: Collection[int],
    hashes: Collection[str],
) -> list[ColumnElement[bool]]:
    """Conditions on the cell; an empty collection makes none."""
    wanted: list[tuple[InstrumentedAttribute[Any], Collection[Any]]] = [
        (CellRow.task, tasks),
        (CellRow.method, methods),
        (CellRow.variant, variants),
        (CellRow.seed, seeds),
        (CellRow.hash, hashes),
    ]
    return [column.in_(values) for column, values in wanted if values]
