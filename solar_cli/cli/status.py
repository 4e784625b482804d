"""``solar status``: every cell of the store and how far it is."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from solar_cli.cli.options import AsJson, Database, Methods, Tasks, Variants
from solar_cli.cli.printing import UNBOUNDED, console, print_json, say, table

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.table import Table

    from solar_cli.cli.selection import Line

PERIOD_SECONDS = 2.0
"""Between two looks at the database with ``--watch``."""
SPARE = ("iteration>", "computing>")
"""Columns that a narrow screen goes without, in this order."""
CUT = ("variant", "note")
"""Columns whose text a narrow screen cuts."""
SHORTEST_NOTE = 12
"""Characters, with the space beside them, below which a note says nothing."""


def command(
    tasks: Tasks = None,
    methods: Methods = None,
    variants: Variants = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Look again until no cell is running.")
    ] = False,
    json: AsJson = False,
    db: Database = None,
) -> None:
    """List the stored cells: state, episodes, time, headline measure, what went wrong.

    \b
    Example:
      solar status --task nav
    """
    from solar_cli.cli.selection import listing, select
    from solar_cli.experiment.provenance import code
    from solar_cli.store.store import Store

    present = code()
    with Store.open(db, read_only=True) as store:

        def look() -> list[Line]:
            return listing(store, select(store, tasks, methods, variants), present)

        lines = look()
        if json:
            print_json([line.plain() for line in lines])
        elif watch and console().is_terminal:
            from rich.live import Live

            with Live(summary(lines), console=console(), auto_refresh=False) as live:
                while any_running(lines):
                    time.sleep(PERIOD_SECONDS)
                    lines = look()
                    live.update(summary(lines), refresh=True)
        else:
            console().print(summary(lines))
            while watch and any_running(lines):
                time.sleep(PERIOD_SECONDS)
                lines = look()
                say(counts(lines))


def any_running(lines: Sequence[Line]) -> bool:
    """Whether there is anything to wait for."""
    return any(line.record.state.value == "running" for line in lines)


def counts(lines: Sequence[Line]) -> str:
    """How many cells are in which state: ``3 cells: 2 finished, 1 running``."""
    states = Counter("stale" if line.stale else line.record.state.value for line in lines)
    inside = ", ".join(f"{count} {state}" for state, count in sorted(states.items()))
    return f"{len(lines)} cell{'s' * (len(lines) != 1)}: {inside}"


def summary(lines: Sequence[Line]) -> RenderableType:
    """The table and the counts below it."""
    from rich.console import Group
    from rich.text import Text

    from solar_cli.cli.selection import Line

    if not lines:
        return Text("no cells yet; start with: solar run --task nav --method solar --seeds 1")
    shown = fitted(Line.COLUMNS, [line.shown() for line in lines], console())
    return Group(shown, Text(counts(lines)))


def fitted(
    columns: Sequence[str], rows: Sequence[Sequence[object]], screen: Console
) -> RenderableType:
    """The table; where the screen is too narrow for it, without some columns, and others cut."""
    unbounded = screen.options.update(max_width=UNBOUNDED)
    everything = table(columns, rows)
    if screen.measure(everything, options=unbounded).maximum <= screen.width:
        return everything
    kept = list(columns)
    without_note = [name for name in columns if name != "note"]

    def made(names: Sequence[str], cut: Sequence[str] = ()) -> Table:
        places = [columns.index(name) for name in names]
        whole = [name for name in names if name != "headline measure>"]
        return table(
            names, [[row[place] for place in places] for row in rows], whole=whole, cut=cut
        )

    for name in SPARE:
        if screen.measure(made(without_note), options=unbounded).maximum <= screen.width:
            break
        without_note.remove(name)
        kept.remove(name)
    left = screen.width - screen.measure(made(without_note), options=unbounded).maximum
    return made(kept if left >= SHORTEST_NOTE else without_note, CUT)
