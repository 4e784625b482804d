"""The stored cells that a listing is about, and what is said of each."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from solar_cli.cli.printing import duration, number
from solar_cli.errors import UsageError, nearest
from solar_cli.settings import card_names, method_names
from solar_cli.store.records import CellRecord, State

if TYPE_CHECKING:
    from solar_cli.store.store import Store


def select(
    store: Store,
    tasks: Sequence[str] | None,
    methods: Sequence[str] | None,
    variants: Sequence[str] | None,
) -> list[CellRecord]:
    """The stored cells of these tasks, methods and variants; all where none is named."""
    require_known(store, tasks, methods, variants)
    return store.cells(tasks=tasks or (), methods=methods or (), variants=variants or ())


def require_known(
    store: Store,
    tasks: Sequence[str] | None,
    methods: Sequence[str] | None,
    variants: Sequence[str] | None,
) -> None:
    """Raise `UsageError` for a name that is neither stored nor known.

    A slip of the pen must not read as "nothing there".
    """
    if not (tasks or methods or variants):
        return
    stored = [record.cell for record in store.cells()]
    _known("task", tasks, {*card_names(), *(cell.task for cell in stored)})
    _known("method", methods, {*method_names(), *(cell.method for cell in stored)})
    _known("variant", variants, {"default", *(cell.variant for cell in stored)})


def _known(kind: str, names: Sequence[str] | None, known: Collection[str]) -> None:
    for name in names or ():
        if name not in known:
            raise UsageError(f"--{kind} {name!r}: nothing is stored of it; {nearest(name, known)}")


def headlines(store: Store, records: Sequence[CellRecord]) -> dict[str, float]:
    """The newest value of each cell's headline measure, by the cell's hash."""
    if not records:
        return {}
    wanted = {record.hash: record.cell.configuration.evaluation.headline for record in records}
    rows = store.metrics(
        hashes=list(wanted), names=sorted(set(wanted.values())), splits=["noise_free"]
    )
    rows = [row for row in rows if row["name"] == wanted[row["cell"]]]
    return {row["cell"]: row["value"] for row in sorted(rows, key=lambda row: row["iteration"])}


@dataclass(frozen=True)
class Line:
    """What a listing says of one cell."""

    record: CellRecord
    headline: float | None
    """newest value of the headline measure; None before the first evaluation"""
    stale: bool
    """finished, by other code than the present"""

    COLUMNS = (
        "cell",
        "task",
        "method",
        "variant",
        "seed>",
        "state",
        "iteration>",
        "episodes>",
        "computing>",
        "headline measure",
        "value>",
        "note",
    )

    def shown(self) -> tuple[object, ...]:
        """The entries of a table's row."""
        record, cell = self.record, self.record.cell
        return (
            record.hash[:8],
            cell.task,
            cell.method,
            cell.variant,
            cell.seed,
            "stale" if self.stale else record.state.value,
            record.iteration,
            record.episodes if record.target is None else f"{record.episodes}/{record.target}",
            duration(record.seconds),
            "" if self.headline is None else cell.configuration.evaluation.headline,
            number(self.headline),
            self.note(),
        )

    def note(self) -> str:
        """Why it ended, or what it does now."""
        last = self.record.last_attempt
        if last is None:
            return ""
        if self.record.state in (State.FAILED, State.DIVERGED):
            return last.error or "no cause was recorded"
        if self.record.state is State.INTERRUPTED:
            return last.error or f"process {last.owner.pid} on {last.owner.host} is gone"
        if self.record.state is State.RUNNING:
            return f"{last.activity} {last.fraction:.0%}" if last.activity else "starting"
        return ""

    def plain(self) -> dict[str, Any]:
        """The same as JSON data."""
        record, cell = self.record, self.record.cell
        return {
            "cell": record.hash,
            "task": cell.task,
            "method": cell.method,
            "variant": cell.variant,
            "seed": cell.seed,
            "state": record.state.value,
            "stale": self.stale,
            "iteration": record.iteration,
            "episodes": record.episodes,
            "target": record.target,
            "steps": record.steps,
            "seconds": record.seconds,
            "headline": cell.configuration.evaluation.headline,
            "value": self.headline,
            "note": self.note(),
            "commit": record.commit,
            "dirty": record.dirty,
        }


def listing(store: Store, records: Sequence[CellRecord], present: Mapping[str, Any]) -> list[Line]:
    """One line a cell; ``present`` is the code that runs now."""
    from solar_cli.experiment.matrix import is_stale

    measured = headlines(store, records)
    return [
        Line(record, measured.get(record.hash), is_stale(record, present)) for record in records
    ]
