"""``solar doctor``: whether this machine has what a run needs."""

from __future__ import annotations

from dataclasses import asdict

import typer

from solar_cli.cli.options import AsJson, Database
from solar_cli.cli.printing import print_json, print_table


def command(json: AsJson = False, db: Database = None) -> None:
    """Check versions, the database, its file system, disk, GL and devices; 1 when one is bad.

    \b
    Example:
      solar doctor
    """
    from solar_cli.experiment.machine import Verdict, checks

    found = list(checks(db))
    if json:
        print_json([asdict(check) for check in found])
    else:
        rows = [(check.name, check.verdict.value, check.found, check.advice) for check in found]
        print_table(("what", "verdict", "found", "what to do"), rows)
    if any(check.verdict is Verdict.BAD for check in found):
        raise typer.Exit(1)
