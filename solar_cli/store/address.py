"""Where a database is, and where the files of its cells are."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

from solar_cli.errors import UsageError
from solar_cli.wording import without_password

DEFAULT = "sqlite:///runs/solar.db"
EXPECTED = "use a file's path, sqlite:///PATH or postgresql://USER@HOST/DATABASE"


@dataclass(frozen=True)
class Location:
    """A database's address, resolved."""

    place: Path | URL
    """the SQLite file, absolute, or the address of a server's database"""
    home: Path
    """folder of the cells' files, absolute"""

    @property
    def address(self) -> str:
        """What opens the same database from any folder; holds the password if there is one."""
        if isinstance(self.place, Path):
            return f"sqlite:///{self.place}"
        return self.place.render_as_string(hide_password=False)

    @property
    def is_new(self) -> bool:
        """Whether a file is still to be made, or is as empty as a failed attempt leaves it."""
        if not isinstance(self.place, Path):
            return False
        return not self.place.exists() or (self.place.is_file() and not self.place.stat().st_size)

    def __str__(self) -> str:
        """For messages: the file, or the address without its password."""
        return without_password(str(self.place))


def locate(address: str | None) -> Location:
    """Resolve ``--db``: an address, a file's path, or ``None`` for ``SOLAR_DB`` or the default.

    Files of cells lie beside ``solar.db``. Any other SQLite file and every server's database has
    a folder of its own, as two databases may hold the same cell; ``SOLAR_HOME`` names the folder
    for a server's database. Raises `UsageError` for an address that is none.
    """
    if address is not None and not address.strip():
        raise UsageError(f"the database's address is empty: {EXPECTED}, or leave it out")
    text = address or os.environ.get("SOLAR_DB") or DEFAULT
    if "://" not in text:
        return _file(text)
    shown, (scheme, _, rest) = without_password(text), text.partition("://")
    if scheme == "sqlite":
        if not rest.startswith("/") or len(rest) == 1:
            raise UsageError(f"database address {shown!r} names no file: {EXPECTED}")
        return _file(rest[1:])
    if scheme not in ("postgresql", "postgres", "postgresql+psycopg"):
        raise UsageError(f"database address {shown!r}: unknown scheme {scheme!r}: {EXPECTED}")
    return _server(f"postgresql+psycopg://{rest}")


def _file(text: str) -> Location:
    if "\0" in text:
        raise UsageError(f"database {text!r} is not a path: {EXPECTED}")
    path = Path(text).expanduser().resolve()
    own = path.with_name(f"{path.name}.files")
    home = path.parent if path.name == "solar.db" else own
    return Location(path, home)


def _server(text: str) -> Location:
    try:
        url = make_url(text)
    except (ArgumentError, ValueError) as error:
        raise UsageError(
            f"database address cannot be read ({without_password(str(error))}): {EXPECTED}"
        ) from error
    if not url.database:
        shown = without_password(str(url))
        raise UsageError(f"database address {shown} names no database: {EXPECTED}")
    home = os.environ.get("SOLAR_HOME") or f"runs/{url.database}.files"
    return Location(url, Path(home).expanduser().resolve())
