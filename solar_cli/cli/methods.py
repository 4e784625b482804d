"""``solar methods``: the methods, and what can be set of one."""

from __future__ import annotations

from typing import Annotated

import typer

from solar_cli.cli.options import AsJson, Database, complete_method
from solar_cli.cli.printing import print_json, print_table


def command(
    name: Annotated[
        str | None, typer.Argument(help="A method's name.", autocompletion=complete_method)
    ] = None,
    json: AsJson = False,
    db: Database = None,
) -> None:
    """List the methods, built in and installed, or every setting of one with its default.

    \b
    Example:
      solar methods solar
    """
    from dataclasses import asdict

    from solar_cli.settings import method, method_names

    if name is not None:
        from solar_cli.cli.configuration import default_lines, print_lines

        print_lines(default_lines(method(name)), json)
        return
    entries = [method(known) for known in method_names()]
    if json:
        print_json([asdict(entry) for entry in entries])
        return
    print_table(
        ("method", "what it does", "source", "learns from", "needs"),
        [
            (entry.name, entry.summary, entry.source, ", ".join(entry.observations), entry.needs)
            for entry in entries
        ],
    )
