"""Which checkpoints of a cell are made, kept and taken up again.

A checkpoint counts once the store knows it: the file is durable before its row is committed, and a
file without a row is left over from a crash. Its name carries the attempt's number, so that a late
writer of an attempt that was taken over can touch no file of the present one.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any

from solar_cli.errors import LostFiles
from solar_cli.store.checkpoints import CorruptCheckpoint, load, save
from solar_cli.store.records import CheckpointRecord
from solar_cli.store.results import CHECKPOINTS
from solar_cli.store.store import Store

NEWEST = 2
"""newest checkpoints kept: the one to go on from, and the one before should that be damaged"""

log = logging.getLogger(__name__)


class Checkpoints:
    """The checkpoints of one attempt at one cell."""

    def __init__(self, store: Store, cell: str, attempt: int) -> None:
        self._store = store
        self._cell = cell
        self._attempt = attempt
        self._folder = store.folder(cell)
        self._milestones = store.find(cell).cell.configuration.evaluation.milestones
        self.damaged: list[str] = []
        """what `restore` had to say about damaged files"""

    def restore(self) -> tuple[CheckpointRecord, dict[str, Any]] | None:
        """The newest checkpoint whose file is what was committed; None without any.

        Damaged ones are reported and forgotten, and so are files that a crash left. Raises
        `LostFiles` where none is left of a cell that has results: to begin anew would discard them.
        """
        known = self._store.checkpoints(self._cell)
        damages = []
        for position, record in enumerate(known):
            try:
                found = record, load(self._folder / record.path, record.sha256)
            except CorruptCheckpoint as error:
                damages.append(str(error))
            else:
                for damage in damages:
                    self._report(f"{damage}; going on from the one before")
                self._keep(known[position:])
                return found
        if known and (known[0].complete or known[0].iteration > 1):
            raise LostFiles(
                f"checkpoints {', '.join(record.path for record in known)} in {self._folder} are "
                "missing or damaged: restore one of them, or start the cell anew with --redo"
            )
        for damage in damages:
            self._report(f"{damage}; starting anew")
        self._keep([])
        return None

    def save(
        self, state: dict[str, Any], iteration: int, episodes: int, position: int, complete: bool
    ) -> CheckpointRecord:
        """Make the file durable; the record is for the commit that follows."""
        path = f"{CHECKPOINTS}/{iteration:04d}-{position:04d}-{self._attempt}.pt"
        sha256, size = save(state, self._folder / path)
        return CheckpointRecord(path, sha256, size, iteration, episodes, position, complete)

    def trim(self) -> None:
        """Forget all but the newest ones, the best by training cost, and those of milestones."""
        known = self._store.checkpoints(self._cell)
        best = best_iteration(self._store, self._cell)
        complete = [record for record in known if record.complete]
        # The policy of the newest complete one is still being tried, and may be the best.
        keep = known[:NEWEST] + complete[:1]
        keep += [record for record in complete if record.iteration == best]
        for milestone in self._milestones:
            reached = [record for record in complete if record.episodes >= milestone]
            keep += reached[-1:]  # the oldest: known ones come newest first
        self._keep(keep)

    def _keep(self, records: Sequence[CheckpointRecord]) -> None:
        paths = [record.path for record in records]
        self._store.forget_checkpoints(self._cell, self._attempt, paths)

    def _report(self, damage: str) -> None:
        log.warning("%s", damage)
        self.damaged.append(damage)


def best_iteration(store: Store, cell: str) -> int | None:
    """The iteration whose policy collected at the lowest cost; None before there is one.

    The policy at the end of iteration k - 1 collects iteration k, so that its training cost is
    known one iteration later.
    """
    rows = store.metrics(hashes=[cell], names=["return"], splits=["train"])
    finite = [row for row in rows if math.isfinite(row["value"])]
    if not finite:
        return None
    best = max(finite, key=lambda row: (row["value"], row["iteration"]))
    return int(best["iteration"]) - 1
