"""One database: its connections, its transactions, and what its errors mean to a user.

SQLite is used with the rollback journal, because its write-ahead log can corrupt a database in the
versions that Python links, and does not work on network file systems. Every write takes the write
lock first (``BEGIN IMMEDIATE``): a transaction that read before it wrote would fail at once, in
spite of the timeout, when another process wrote in between.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

from sqlalchemy import URL, Connection, Engine, QueuePool, create_engine, event, func, select, text
from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.orm import Session

from solar_cli.errors import SolarError, UsageError
from solar_cli.store.address import Location

WAIT = 60.0
"""seconds that a connection waits for another's lock"""
LOCK = 0x501A5
"""number of the advisory lock under which a server's schema is made and cells are added"""


class Database:
    """Connections to one database. Raises only `SolarError` for what a user can mend."""

    def __init__(self, location: Location, *, read_only: bool) -> None:
        self.location = location
        self.read_only = read_only
        place = location.place
        self._engine = (
            _sqlite(place, read_only=read_only) if isinstance(place, Path) else _server(place)
        )
        self._reader = self._engine
        if not self.sqlite:  # one snapshot for all statements of a reading, as SQLite has
            self._reader = self._engine.execution_options(
                isolation_level="REPEATABLE READ", postgresql_readonly=True
            )
        self._writer = self._engine.execution_options(writes=True)

    @property
    def sqlite(self) -> bool:
        """Whether it is a file."""
        return isinstance(self.location.place, Path)

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """One consistent snapshot. Leave it soon: on SQLite no writer can commit meanwhile."""
        with self._explained(), Session(self._reader) as session:
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """One write transaction, alone on SQLite: all of it is stored, or nothing."""
        with self._explained(), Session(self._writer) as session, session.begin():
            yield session

    @contextmanager
    def altering(self) -> Iterator[Connection]:
        """One transaction that changes the schema, alone on every kind of database."""
        with self._explained(), self._writer.begin() as connection:
            self._lock(connection)
            yield connection

    def serialise(self, session: Session) -> None:
        """Let no other transaction that asks for the same run until this one ends."""
        self._lock(session.connection())

    def _lock(self, connection: Connection) -> None:
        if not self.sqlite:  # SQLite has one writer at a time anyway
            connection.execute(select(func.pg_advisory_xact_lock(LOCK)))

    def now(self, session: Session) -> datetime:
        """The time by the one clock that all processes share: the server's, if there is one."""
        if self.sqlite:
            return datetime.now(UTC)
        moment: datetime = session.execute(select(func.clock_timestamp())).scalar_one()
        return moment.astimezone(UTC)

    def diagnose(self) -> dict[str, str]:
        """Version, size and health of the database."""
        if not isinstance(self.location.place, Path):
            with self.reading() as session:
                version = session.execute(text("SHOW server_version")).scalar_one()
                size = session.execute(
                    select(func.pg_database_size(func.current_database()))
                ).scalar_one()
            return {"PostgreSQL": version, "bytes": str(size)}
        with self.reading() as session:
            answers = {
                name: "; ".join(str(row[0]) for row in session.execute(text(f"PRAGMA {name}")))
                for name in ("journal_mode", "integrity_check", "foreign_key_check")
            }
        return {
            "SQLite": sqlite3.sqlite_version,
            "journal": answers["journal_mode"],
            "file system": file_system(self.location.place),
            "bytes": str(self.location.place.stat().st_size),
            "integrity": answers["integrity_check"],
            "references": answers["foreign_key_check"] or "ok",
        }

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except DBAPIError as error:
            raise explain(error, self.location) from error


def _sqlite(path: Path, *, read_only: bool) -> Engine:
    # A reader opens for writing too, though it never creates the file nor changes a row: what a
    # killed writer left half done is rolled back by whoever opens the database next.
    uri = f"file:{quote(str(path))}?mode={'rw' if read_only else 'rwc'}"

    def connect() -> sqlite3.Connection:
        connection = sqlite3.connect(
            uri, uri=True, timeout=WAIT, isolation_level=None, check_same_thread=False
        )
        connection.execute("PRAGMA foreign_keys = ON")
        if read_only:
            connection.execute("PRAGMA query_only = ON")
        else:
            connection.execute("PRAGMA journal_mode = DELETE")
            connection.execute("PRAGMA synchronous = FULL")
        return connection

    engine = create_engine("sqlite://", creator=connect, poolclass=QueuePool)

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        writes = connection.get_execution_options().get("writes", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    return engine


def _server(url: URL) -> Engine:
    try:
        return create_engine(url, pool_pre_ping=True, connect_args={"connect_timeout": 10})
    except ModuleNotFoundError as error:
        raise UsageError(
            f"database {url} needs the PostgreSQL driver: pip install 'solar-cli[postgresql]'"
        ) from error


def file_system(path: Path) -> str:
    """Type of the file system that holds ``path``, such as ext4 or nfs4; ``unknown`` off Linux."""
    try:
        lines = Path("/proc/self/mounts").read_text().splitlines()
    except OSError:
        return "unknown"
    mounts = [line.split()[1:3] for line in lines]
    # The longest mount point that is a parent; of two on one point the later lies on top.
    holding = [(len(at), kind) for at, kind in mounts if path.is_relative_to(at)]
    return max(enumerate(holding), key=lambda item: (item[1][0], item[0]))[1][1]


def explain(error: DBAPIError, location: Location) -> Exception:
    """What a driver's error means: where, what, and what to do; itself where it is our mistake."""
    cause = str(error.orig).strip().splitlines()[0] if str(error.orig).strip() else "no reason"
    code = str(getattr(error.orig, "sqlite_errorname", ""))
    for prefix, (kind, message) in SQLITE_ERRORS.items():
        if code.startswith(prefix):
            return kind(f"database {location}: {message} ({cause})")
    if not code and isinstance(error, OperationalError):
        if getattr(error.orig, "sqlstate", None):
            return SolarError(
                f"database {location}: its server failed; nothing stored is lost: see to it, then "
                f"try again ({cause})"
            )
        return UsageError(
            f"database {location} cannot be reached ({cause}): start the server, or correct the "
            "address in --db or SOLAR_DB"
        )
    if "InsufficientPrivilege" in type(error.orig).__name__:
        return UsageError(f"database {location}: {cause}: ask for that right, or use another user")
    return error


SQLITE_ERRORS: dict[str, tuple[type[SolarError], str]] = {
    "SQLITE_BUSY": (
        SolarError,
        f"locked by another process for over {WAIT:.0f} s; end that process, then try again",
    ),
    "SQLITE_FULL": (
        SolarError,
        "its disk is full; nothing stored is lost: make room, then try again",
    ),
    "SQLITE_IOERR": (
        SolarError,
        "its disk cannot be read or written; check the disk and its free space, then try again",
    ),
    "SQLITE_PROTOCOL": (
        SolarError,
        "its file system cannot lock files; keep it on a local disk, or use PostgreSQL",
    ),
    "SQLITE_READONLY": (UsageError, "it or its folder cannot be written; name another in --db"),
    "SQLITE_CANTOPEN": (
        UsageError,
        "cannot be opened; check that its folder exists and can be written",
    ),
    "SQLITE_NOTADB": (UsageError, "not a Solar database; name another file in --db"),
    "SQLITE_CORRUPT": (
        SolarError,
        "the file is damaged; copy it away, then see what `solar doctor` says",
    ),
}
