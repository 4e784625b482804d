"""Bringing a database to this program's schema.

Every change happens in one transaction under an exclusive lock: whoever is killed in the middle
leaves the old schema, and of several processes that open a new database one creates it while the
others wait.
"""

from __future__ import annotations

import os
from pathlib import Path

from sqlalchemy import Connection, inspect, text

from solar_cli.errors import UsageError
from solar_cli.store.address import Location
from solar_cli.store.database import Database
from solar_cli.store.schema import HEAD, PREFIX, VERSIONS

SCRIPTS = Path(__file__).parent / "migrations"


def open_database(location: Location, *, read_only: bool) -> Database:
    """Connect and, unless ``read_only``, create or upgrade.

    Raises `UsageError` when there is no database to read, when it is not ours, newer than this
    program, or cannot be written or reached.
    """
    if isinstance(location.place, Path):
        _check_file(location.place, read_only=read_only)
    database = Database(location, read_only=read_only)
    try:
        with database.reading() as session:
            found = revision(session.connection(), location)
        if found == HEAD:
            return database
        if read_only:
            state = "holds nothing yet" if found is None else f"has the older schema {found}"
            raise UsageError(f"database {location} {state}: `solar run` fills and upgrades it")
        with database.altering() as connection:
            if revision(connection, location) != HEAD:
                upgrade(connection)
    except BaseException:
        database.close()
        raise
    return database


def revision(connection: Connection, location: Location) -> str | None:
    """The schema's revision; ``None`` for an empty database.

    Raises `UsageError` for somebody else's database and for one of a newer program.
    """
    tables = inspect(connection).get_table_names()
    if not tables:
        return None
    found = ""
    if "alembic_version" in tables:
        found = connection.execute(text("SELECT version_num FROM alembic_version")).scalar() or ""
    if found in VERSIONS:
        return found
    if found.startswith(PREFIX):
        raise UsageError(
            f"database {location} has schema {found}, newer than this program ({HEAD}): "
            "upgrade solar-cli, or name another database in --db"
        )
    raise UsageError(f"database {location}: not a Solar database; name another in --db")


def upgrade(connection: Connection, target: str = HEAD) -> None:
    """Run the migrations up to ``target`` inside the transaction of ``connection``."""
    from alembic import command  # only here: it costs 0.3 s that a current database need not pay
    from alembic.config import Config

    config = Config(attributes={"connection": connection})
    config.set_main_option("script_location", str(SCRIPTS).replace("%", "%%"))
    command.upgrade(config, target)


def _check_file(path: Path, *, read_only: bool) -> None:
    """See to the folder of a SQLite file, and refuse what cannot become one."""
    if path.exists() and not path.is_file():
        raise UsageError(f"database {path} is a folder or device: name a file in --db")
    if read_only:
        if not path.exists():
            raise UsageError(f"no database at {path}: `solar run` makes one, --db names another")
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"folder {path.parent} of the database cannot be made ({error.strerror}): "
            "name another place in --db"
        ) from error
    for place in (path, path.parent):  # the rollback journal lies beside the file
        if place.exists() and not os.access(place, os.W_OK):
            raise UsageError(f"{place} cannot be written: change its rights, or name another --db")
