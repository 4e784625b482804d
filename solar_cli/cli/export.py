"""``solar export``: the stored metrics as a file that other programs read."""

from __future__ import annotations

import io
import sys
from enum import StrEnum
from typing import Annotated

import typer

from solar_cli.cli.options import Database, Force, Methods, Output, Tasks, Variants
from solar_cli.cli.printing import deliver
from solar_cli.errors import UsageError


class Format(StrEnum):
    """What to write."""

    CSV = "csv"
    JSON = "json"
    PARQUET = "parquet"


def command(
    format: Annotated[Format, typer.Option("--format", help="Kind of file.")] = Format.CSV,
    output: Output = None,
    force: Force = False,
    tasks: Tasks = None,
    methods: Methods = None,
    variants: Variants = None,
    db: Database = None,
) -> None:
    """Write one row a metric; its split is train, noise_free or model.

    \b
    Example:
      solar export --format csv --task nav --output nav.csv
    """
    from solar_cli.cli.selection import require_known
    from solar_cli.reporting.frames import export, frame
    from solar_cli.store.store import Store

    if format is Format.PARQUET and output is None and sys.stdout.isatty():
        raise UsageError("--format parquet is no text for a terminal; add --output FILE")
    with Store.open(db, read_only=True) as store:
        require_known(store, tasks, methods, variants)
        metrics = frame(store, tasks=tasks or (), methods=methods or (), variants=variants or ())
    file = io.BytesIO()
    export(metrics, format.value, file)
    deliver(file.getvalue(), output, force)
