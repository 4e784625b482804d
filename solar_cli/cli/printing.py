"""How every command prints: tables, lines, JSON, files.

Text from a database, a card or a log is foreign: it is printed without control characters and never
read as Rich markup, so that no stored name can move the cursor or colour the screen.
"""

from __future__ import annotations

import json
import math
import os
import sys
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from solar_cli.errors import UsageError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

UNBOUNDED = 100_000
"""Width of a table that is not shown on a terminal, where nothing may be cut."""
WIDEST = 60
"""Characters of a table's column before its text goes on in the next line."""


def clean(text: object) -> str:
    """``text`` on one line, without anything that a terminal would obey."""
    return "".join(
        " " if character in "\n\r\t" else character
        for character in str(text)
        if character in "\n\r\t" or not unicodedata.category(character).startswith("C")
    )


def console(*, error: bool = False) -> Console:
    """Where to print; made when it is used, so that a replaced standard output is respected."""
    from rich.console import Console

    stream = sys.stderr if error else sys.stdout
    width = None if stream.isatty() or os.environ.get("COLUMNS", "").isdecimal() else UNBOUNDED
    return Console(file=stream, width=width, highlight=False, markup=False, emoji=False)


def say(line: object = "") -> None:
    """One line on standard output."""
    sys.stdout.write(f"{clean(line)}\n")


def complain(line: object) -> None:
    """One line on standard error."""
    sys.stderr.write(f"{clean(line)}\n")


def table(
    columns: Sequence[str],
    rows: Iterable[Sequence[object]],
    title: str = "",
    *,
    cut_to: Mapping[str, int] | None = None,
) -> Table:
    """A Rich table; columns whose name ends in ``>`` are set to the right.

    A text that is longer than its column goes on in the next line. With ``cut_to``, the width of
    each column, it is cut instead, and the table has no margin.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    made = Table(box=box.SIMPLE_HEAD, title=title or None, title_justify="left", pad_edge=False)
    if cut_to is not None:
        made.show_edge, made.padding = False, (0, 1, 0, 0)
    for name in columns:
        made.add_column(
            name.rstrip(">"),
            justify="right" if name.endswith(">") else "left",
            overflow="fold" if cut_to is None else "ellipsis",
            no_wrap=cut_to is not None,
            max_width=WIDEST if cut_to is None else cut_to[name],
        )
    for row in rows:
        made.add_row(*(Text("" if value is None else clean(value)) for value in row))
    return made


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], title: str = "") -> None:
    """Print a table to standard output."""
    console().print(table(columns, rows, title))


def as_json(data: Any) -> str:
    """Valid JSON: what is not finite becomes null."""
    return json.dumps(_finite(data), ensure_ascii=False, default=str)


def print_json(data: Any) -> None:
    """Print one line of JSON to standard output."""
    sys.stdout.write(f"{as_json(data)}\n")


def _finite(data: Any) -> Any:
    if isinstance(data, float) and not math.isfinite(data):
        return None
    if isinstance(data, dict):
        return {str(key): _finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    return data


def number(value: float | None) -> str:
    """A measure in four digits."""
    return "" if value is None else f"{value:.4g}"


def duration(seconds: float | None) -> str:
    """``45 s``, ``3 min 20 s`` or ``2 h 05 min``."""
    if seconds is None or not math.isfinite(seconds):
        return ""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def require_free(option: str, output: str, force: bool) -> None:
    """Raise `UsageError` for a file that exists, and one whose folder does not."""
    path = Path(output)
    if path.exists() and not force:
        raise UsageError(f"{option} {output}: the file exists; add --force to overwrite it")
    if not path.parent.is_dir():
        raise UsageError(f"{option} {output}: there is no folder {path.parent}; make it first")


def deliver(
    content: str | bytes, output: str | None, force: bool, option: str = "--output"
) -> None:
    """Write to standard output, or whole or not at all to the file that ``option`` names.

    Raises `UsageError` for a file that exists and one that cannot be written.
    """
    data = content.encode() if isinstance(content, str) else content
    if output is None:
        if isinstance(content, str):
            sys.stdout.write(content)
        else:
            sys.stdout.buffer.write(data)
        return
    require_free(option, output, force)
    path = Path(output)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_bytes(data)
        beside.replace(path)
    except OSError as error:
        raise UsageError(
            f"{option} {output}: {error.strerror or error}; name a file in a folder you may write"
        ) from error
    complain(f"wrote {output} ({len(data)} bytes)")
