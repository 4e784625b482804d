"""``solar status``: every cell of the store and how far it is."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from solar_cli.cli.options import AsJson, Database, Methods, Tasks, Variants
from solar_cli.cli.printing import console, print_json, say
from solar_cli.wording import counted

if TYPE_CHECKING:
    from rich.console import RenderableType

    from solar_cli.cli.selection import Line

PERIOD_SECONDS = 2.0
"""Between two looks at the database with ``--watch``."""


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
    return f"{counted(len(lines), 'cell')}: {inside}"


def summary(lines: Sequence[Line]) -> RenderableType:
    """The table and the counts below it."""
    from rich.console import Group
    from rich.text import Text

    from solar_cli.cli.fitting import fitted
    from solar_cli.cli.selection import Line

    if not lines:
        return Text("no cells yet; start with: solar run --task nav --method solar --seeds 1")
    shown = fitted(Line.COLUMNS, [line.shown() for line in lines], console().width)
    return Group(shown, Text(counts(lines)))
