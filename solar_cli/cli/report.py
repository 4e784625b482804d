"""``solar report``: curves, tables and one page of everything stored."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from solar_cli.cli.options import AsJson, Database
from solar_cli.cli.printing import print_json, say


def command(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write into.")] = Path(
        "reports/latest"
    ),
    json: AsJson = False,
    db: Database = None,
) -> None:
    """Write learning curves, tables, an offline HTML page and animations of what was learned.

    \b
    Example:
      solar report --out reports/latest
    """
    from solar_cli.reporting.report import report
    from solar_cli.store.store import Store

    with Store.open(db, read_only=True) as store:
        written = report(store, out)
    if json:
        print_json({"lines": list(written.lines), "paths": [str(path) for path in written.paths]})
        return
    for line in written.lines:
        say(line)
    say(f"page: {written.index}")
    for path in written.paths:
        if path.name == "curve.png":
            say(f"curve: {path}")
        elif path.suffix == ".gif":
            say(f"animation: {path}")
