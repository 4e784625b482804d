"""``solar rm``: remove cells and their files."""

from __future__ import annotations

from typing import Annotated

import typer

from solar_cli.cli.options import Database, Methods, Tasks, Variants
from solar_cli.cli.printing import print_table, say
from solar_cli.errors import UsageError


def command(
    cells: Annotated[
        list[str] | None, typer.Argument(metavar="CELL...", help="First digits of their hashes.")
    ] = None,
    tasks: Tasks = None,
    methods: Methods = None,
    variants: Variants = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    db: Database = None,
) -> None:
    """Remove cells, with everything stored of them; asks first.

    \b
    Example:
      solar rm --task nav --variant smoke
    """
    from solar_cli.cli.selection import select
    from solar_cli.store.store import Store

    filtered = bool(tasks or methods or variants)
    if bool(cells) == filtered:
        raise UsageError(
            "name the cells to remove by their hashes, or by --task, --method and --variant"
        )
    with Store.open(db, read_only=True) as store:  # a slip in --db makes no database
        if cells:
            named = [store.find(prefix) for prefix in cells]
            records = list({record.hash: record for record in named}.values())
        else:
            records = select(store, tasks, methods, variants)
        if not records:
            say("nothing to remove")
            return
        print_table(
            ("cell", "title", "state", "episodes>"),
            [(r.hash[:8], r.cell.title, r.state.value, r.episodes) for r in records],
        )
    if not yes:
        typer.confirm(f"Remove {len(records)} with all files?", abort=True)
    with Store.open(db) as store:
        store.remove([record.hash for record in records])
    say(f"removed {len(records)}")
