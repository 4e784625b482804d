"""The matrix: which cells there are to do, and why, in one phrase a cell.

Nothing here imports torch: a finished matrix is recognised within a second.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Literal

from solar_cli.experiment.provenance import code, code_name, same_code
from solar_cli.settings import Cell
from solar_cli.store.records import CellRecord, State
from solar_cli.wording import counted

if TYPE_CHECKING:
    from solar_cli.store.store import Store


class Action(StrEnum):
    """What a run is to do with a cell."""

    RUN = "run"
    """compute it from its beginning"""
    REDO = "redo"
    """discard what is stored, then compute it from its beginning"""
    RESUME = "resume"
    """go on from the last checkpoint of an attempt that did not finish"""
    CONTINUE = "continue"
    """go on from the end of a finished cell, to more episodes"""
    SKIP = "skip"
    """finished"""
    STALE = "stale"
    """finished by other code than the present: neither rerun nor counted as missing"""
    BLOCKED = "blocked"
    """not finished, and not to be touched: it runs elsewhere, or --retry is missing"""


WORK = frozenset({Action.RUN, Action.REDO, Action.RESUME, Action.CONTINUE})
"""The actions that take a worker."""


@dataclass(frozen=True)
class Plan:
    """What to do with one cell."""

    cell: Cell
    target: int
    """episodes to stop at"""
    action: Action
    why: str
    """one phrase, for people"""
    record: CellRecord | None = None
    """what the store knew of the cell; None for a new one"""

    @property
    def is_work(self) -> bool:
        """Whether a worker is needed."""
        return self.action in WORK


def plan(
    store: Store,
    cells: Sequence[Cell],
    wanted: Literal["desk", "full"] | int = "desk",
    *,
    redo: bool = False,
    retry: bool = False,
    present: Mapping[str, Any] | None = None,
) -> list[Plan]:
    """Decide for each of ``cells``, in their order; reads the store, writes nothing.

    ``wanted`` is the budget in episodes, ``present`` the code that would run (`provenance.code`).
    """
    known = {record.hash: record for record in store.cells(hashes=[cell.hash for cell in cells])}
    present = code() if present is None else present
    plans = []
    for cell in cells:
        record, target = known.get(cell.hash), cell.budget(wanted)
        action, why = _decide(record, target, redo, retry, present)
        plans.append(Plan(cell, target, action, why, record))
    return plans


def is_stale(record: CellRecord, present: Mapping[str, Any]) -> bool:
    """Whether a finished cell was computed by other code than ``present``."""
    return (
        record.state is State.FINISHED
        and record.last_attempt is not None
        and not same_code(record.last_attempt.provenance, present)
    )


def _decide(
    record: CellRecord | None, target: int, redo: bool, retry: bool, present: Mapping[str, Any]
) -> tuple[Action, str]:
    if record is None or record.last_attempt is None:
        return Action.RUN, "not yet computed"
    owner = record.last_attempt.owner
    if record.state is State.RUNNING:
        return Action.BLOCKED, f"runs on {owner.host}, process {owner.pid}"
    had = counted(record.episodes, "episode")
    if redo:
        return Action.REDO, f"--redo discards {had} ({record.state.value})"
    progress = f"iteration {record.iteration}, {record.episodes} of {counted(target, 'episode')}"
    if record.state is State.FINISHED:
        return _decide_finished(record, target, present)
    if record.state is State.INTERRUPTED:
        return Action.RESUME, f"interrupted in {progress}"
    cause = record.last_attempt.error or "unknown cause"
    if retry:
        return Action.RESUME, f"--retry after it {_verb(record.state)}: {cause}"
    return Action.BLOCKED, f"{_verb(record.state)} in {progress}: {cause}; --retry tries again"


def _decide_finished(
    record: CellRecord, target: int, present: Mapping[str, Any]
) -> tuple[Action, str]:
    stale = is_stale(record, present)
    by = code_name(record.last_attempt.provenance) if record.last_attempt else "unknown code"
    if record.episodes < target:
        other = f", computed by {by}" if stale else ""
        return Action.CONTINUE, f"has {record.episodes} of {counted(target, 'episode')}{other}"
    if stale:
        return (
            Action.STALE,
            f"computed by {by}, not by {code_name(present)}; --redo computes it anew",
        )
    return Action.SKIP, f"finished with {counted(record.episodes, 'episode')}"


def _verb(state: State) -> str:
    return "diverged" if state is State.DIVERGED else "failed"
