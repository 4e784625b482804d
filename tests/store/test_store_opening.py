"""Opening: what is no database of ours is refused in one line, and nothing of it is changed."""

import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy.exc import OperationalError

from solar_cli.errors import SolarError, UsageError
from solar_cli.settings import Cell
from solar_cli.store import database
from solar_cli.store.address import locate
from solar_cli.store.database import explain
from solar_cli.store.store import Store

MakeCells = Callable[..., list[Cell]]


def text_file(path: Path) -> None:
    path.write_text("seed,return\n" * 100)


def empty_folder(path: Path) -> None:
    path.mkdir()


def foreign_database(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE cell (hash)")


def foreign_alembic_database(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE alembic_version (version_num)")
        connection.execute("INSERT INTO alembic_version VALUES ('1bd49d398cd2')")


def newer_database(path: Path) -> None:
    Store.open(str(path)).close()
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE alembic_version SET version_num = 'solar_9999'")


def truncated_database(path: Path) -> None:
    Store.open(str(path)).close()
    path.write_bytes(path.read_bytes()[:5000])


@pytest.mark.parametrize("read_only", [False, True])
@pytest.mark.parametrize(
    ("make", "says"),
    [
        (text_file, "not a Solar database"),
        (empty_folder, "folder"),
        (foreign_database, "not a Solar database"),
        (foreign_alembic_database, "not a Solar database"),
        (newer_database, "newer than this program"),
        (truncated_database, "damaged"),
    ],
)
def test_what_is_no_database_of_ours_is_refused_and_left_as_it_is(
    make: Callable[[Path], None], says: str, read_only: bool, tmp_path: Path
) -> None:
    path = tmp_path / "given.db"
    make(path)
    before = path.read_bytes() if path.is_file() else None
    with pytest.raises(SolarError, match=says) as caught:
        Store.open(str(path), read_only=read_only)
    refused(caught.value, str(path))
    assert before == (path.read_bytes() if path.is_file() else None)
    assert [each.name for each in tmp_path.iterdir()] == ["given.db"]


def refused(error: SolarError, where: str) -> None:
    """One line that says where, and after it what to do."""
    message = str(error)
    assert "\n" not in message
    assert where in message
    assert any(mark in message.partition(where)[2] for mark in (":", ";"))


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("mysql://host/solar", "unknown scheme 'mysql'"),
        ("sqlite://", "names no file"),
        ("sqlite:///", "names no file"),
        ("a\0b", "is not a path"),
        ("postgresql://host", "names no database"),
        ("postgresql://host:port/solar", "cannot be read"),
        ("/dev/null", "folder or device"),
        ("/dev/null/solar.db", "cannot be made"),
        ("/proc/solar.db", "/proc"),
        ("postgresql://me:secret@127.0.0.1:1/solar", "cannot be reached"),
    ],
)
def test_an_address_that_leads_nowhere_is_a_usage_error(address: str, says: str) -> None:
    with pytest.raises(UsageError, match=says) as caught:
        Store.open(address)
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value)


def test_a_read_only_folder_is_a_usage_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Rights do not bind root, which tests may run as: what the system would say is said for it.
    monkeypatch.setattr("os.access", lambda path, mode: path != tmp_path)
    with pytest.raises(UsageError, match="cannot be written"):
        Store.open(str(tmp_path / "solar.db"))
    assert list(tmp_path.iterdir()) == []


def test_reading_never_creates_a_file(tmp_path: Path) -> None:
    path = tmp_path / "new" / "solar.db"
    with pytest.raises(UsageError, match="no database at"):
        Store.open(str(path), read_only=True)
    assert list(tmp_path.iterdir()) == []
    path = tmp_path / "empty.db"
    path.touch()
    with pytest.raises(UsageError, match="holds nothing yet"):
        Store.open(str(path), read_only=True)
    assert path.stat().st_size == 0


def test_a_reader_cannot_write(sqlite_store: Store, make_cells: MakeCells) -> None:
    with (
        Store.open(sqlite_store.address, read_only=True) as reader,
        pytest.raises(SolarError, match="cannot be written"),
    ):
        reader.add(make_cells(0))
    assert sqlite_store.cells() == []


def test_a_reader_repairs_what_a_killed_writer_left(
    tmp_path: Path, make_cells: MakeCells, environment: dict[str, str]
) -> None:
    path = tmp_path / "solar.db"
    with Store.open(str(path)) as store:
        store.add(make_cells(0))
    # A cache of one page makes SQLite write to the file before it commits.
    script = (
        "import os, sqlite3, sys; c = sqlite3.connect(sys.argv[1], isolation_level=None); "
        "c.execute('PRAGMA cache_size = 1'); c.execute('BEGIN IMMEDIATE'); "
        "c.execute('CREATE TABLE t (x)'); c.execute('DROP TABLE metric'); "
        "c.executemany('INSERT INTO t VALUES (?)', [('x' * 3000,)] * 200); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", script, str(path)], env=environment, check=False)
    assert (tmp_path / "solar.db-journal").stat().st_size > 0
    with Store.open(str(path), read_only=True) as store:
        assert len(store.cells()) == 1
        assert store.metrics() == []
        assert store.diagnose()["integrity"] == "ok"


def test_addresses_of_one_file_are_one_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "runs" / "solar.db"
    monkeypatch.delenv("SOLAR_DB", raising=False)
    for address in (None, "runs/solar.db", "sqlite:///runs/solar.db", f"sqlite:///{path}"):
        assert locate(address).address == f"sqlite:///{path}"
        assert locate(address).home == tmp_path / "runs"
    monkeypatch.setenv("SOLAR_DB", "other.db")
    assert locate(None).place == tmp_path / "other.db"
    odd = tmp_path / "50% of #1?.db"
    assert locate(locate(str(odd)).address).place == odd
    with Store.open(str(odd)):
        assert odd.is_file()


@pytest.mark.parametrize("address", ["", "  "])
def test_an_empty_address_is_no_default(address: str) -> None:
    with pytest.raises(UsageError, match="the database's address is empty"):
        locate(address)


def test_two_databases_never_share_the_files_of_a_cell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SOLAR_HOME", raising=False)
    addresses = ["solar.db", "other.db", "other.sqlite", "runs/solar.db"]
    addresses += ["postgresql://host/solar", "postgresql://host/other"]
    assert len({locate(address).home for address in addresses}) == len(addresses)
    monkeypatch.setenv("SOLAR_HOME", "/shared")
    assert locate("postgresql://host/solar").home == Path("/shared")


def test_a_password_opens_the_database_and_is_never_shown() -> None:
    location = locate("postgresql://me:secret@host/solar")
    assert "secret" in location.address
    assert "secret" not in str(location)


def test_a_locked_database_is_one_clear_line(
    tmp_path: Path, make_cells: MakeCells, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database, "WAIT", 0.05)
    with Store.open(str(tmp_path / "solar.db")) as store:
        holder = sqlite3.connect(tmp_path / "solar.db", isolation_level=None)
        holder.execute("BEGIN IMMEDIATE")
        with pytest.raises(SolarError, match="locked by another process"):
            store.add(make_cells(0))
        holder.execute("COMMIT")
        store.add(make_cells(0))
        assert len(store.cells()) == 1


def pragma(store: Store, text: str) -> int:
    """The value of a setting of SQLite, as the store's own connection has it."""
    with store._database._engine.connect() as connection:
        return int(connection.exec_driver_sql(f"PRAGMA {text}").scalar_one())


def test_a_full_disk_loses_nothing_and_work_goes_on_once_there_is_room(
    sqlite_store: Store, make_cells: MakeCells
) -> None:
    store = sqlite_store
    store.add(make_cells(0))
    pragma(store, f"max_page_count = {pragma(store, 'page_count')}")
    with pytest.raises(SolarError, match="disk is full"):
        store.add(make_cells(*range(1, 100)))
    assert len(store.cells()) == 1
    assert store.diagnose()["integrity"] == "ok"
    pragma(store, "max_page_count = 100000")
    store.add(make_cells(*range(1, 100)))
    assert len(store.cells()) == 100


def sqlite_error(code: str) -> sqlite3.Error:
    error = sqlite3.OperationalError("what SQLite says\nand more")
    error.sqlite_errorname = code
    return error


def server_error(state: str | None) -> Exception:
    error = Exception("what the server says\nand more")
    error.sqlstate = state  # type: ignore[attr-defined]
    return error


@pytest.mark.parametrize(
    ("cause", "kind", "says"),
    [
        (sqlite_error("SQLITE_IOERR_WRITE"), SolarError, "check the disk"),
        (sqlite_error("SQLITE_PROTOCOL"), SolarError, "local disk"),
        (sqlite_error("SQLITE_CORRUPT_INDEX"), SolarError, "damaged"),
        (server_error("53100"), SolarError, "its server failed"),  # disk full
        (server_error(None), UsageError, "cannot be reached"),
    ],
)
def test_a_failing_database_is_one_line_with_its_cause(
    cause: Exception, kind: type[SolarError], says: str
) -> None:
    error = explain(OperationalError("SELECT", {}, cause), locate("some.db"))
    assert type(error) is kind
    assert says in str(error)
    assert "says" in str(error)
    refused(error, "some.db")


def test_a_mistake_of_ours_is_not_explained_away() -> None:
    error = OperationalError("SELECT", {}, sqlite_error("SQLITE_ERROR"))
    assert explain(error, locate("some.db")) is error


def test_listing_cells_imports_nothing_heavy(
    sqlite_store: Store, make_cells: MakeCells, environment: dict[str, str]
) -> None:
    sqlite_store.add(make_cells(0))
    script = (
        "import sys; from solar_cli.store.store import Store\n"
        "with Store.open(sys.argv[1], read_only=True) as store: assert len(store.cells()) == 1\n"
        "heavy = {'torch', 'scipy', 'matplotlib', 'gymnasium', 'pandas', 'alembic'}\n"
        "print(*sorted(heavy & set(sys.modules)))"
    )
    run = subprocess.run(
        [sys.executable, "-c", script, sqlite_store.address],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.strip() == ""
