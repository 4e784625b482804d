"""``solar compare``: is one method better than another, by how much, and how sure is that?"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from solar_cli.cli.options import AsJson, Database, Force, Output, Tasks, complete_method
from solar_cli.cli.printing import deliver, print_table, say


class Format(StrEnum):
    """How to write a comparison."""

    TABLE = "table"
    MARKDOWN = "markdown"
    LATEX = "latex"
    JSON = "json"


def command(
    left: Annotated[
        str | None,
        typer.Argument(
            metavar="M1[:VARIANT]",
            help="A method; bare, every method is compared.",
            autocompletion=complete_method,
        ),
    ] = None,
    right: Annotated[
        str | None,
        typer.Argument(
            metavar="M2[:VARIANT]", help="Another; else solar.", autocompletion=complete_method
        ),
    ] = None,
    task: Tasks = None,
    format: Annotated[Format, typer.Option("--format", help="How to write it.")] = Format.TABLE,
    json: AsJson = False,
    output: Output = None,
    force: Force = False,
    db: Database = None,
) -> None:
    """Compare final performance and episodes to each level, with 95 % intervals.

    \b
    Example:
      solar compare ppo solar --task nav --format markdown
    """
    from solar_cli.cli.selection import require_known
    from solar_cli.reporting.compare import compare
    from solar_cli.store.store import Store

    with Store.open(db, read_only=True) as store:
        require_known(store, task, None, None)
        comparison = compare(store, left, right, task or ())
    chosen = Format.JSON if json else format
    if chosen is Format.TABLE and output is not None:
        chosen = Format.MARKDOWN
    if chosen is Format.TABLE:
        for problem, shown in comparison.tables.items():
            print_table(shown.columns, shown.rows, problem)
            for note in shown.notes:
                say(f"- {note}")
        return
    texts = {
        Format.MARKDOWN: comparison.to_markdown,
        Format.LATEX: comparison.to_latex,
        Format.JSON: comparison.to_json,
    }
    deliver(texts[chosen]().rstrip("\n") + "\n", output, force)
