"""A store of each kind of database, and what the tests of it need to write results."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine

from solar_cli.settings import Cell, cells, load_card
from solar_cli.store.address import locate
from solar_cli.store.owner import Owner
from solar_cli.store.store import Store


@pytest.fixture(scope="session")
def postgresql() -> Iterator[str]:
    """Address of a PostgreSQL server of this session."""
    pgserver = pytest.importorskip("pgserver", reason="needs pgserver to start PostgreSQL")
    pytest.importorskip("psycopg", reason="needs psycopg to reach PostgreSQL")
    # Not below pytest's folder: as root the server runs as another user, and every start of
    # pytest on the machine closes that folder to others.
    folder = Path(tempfile.mkdtemp(prefix="solar-postgresql-"))
    try:
        with pgserver.get_server(folder, cleanup_mode="stop") as server:
            yield server.get_uri()
    except subprocess.SubprocessError as error:
        pytest.skip(f"PostgreSQL does not start here: {error}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def server(postgresql: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Address of an empty database on a server."""
    monkeypatch.setenv("SOLAR_HOME", str(tmp_path))
    yield postgresql
    engine = create_engine(str(locate(postgresql).place))
    with engine.begin() as connection:
        connection.exec_driver_sql("DROP SCHEMA public CASCADE; CREATE SCHEMA public")
    engine.dispose()


@pytest.fixture(params=["sqlite", "postgresql"])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Address of an empty database of each kind."""
    if request.param == "sqlite":
        return str(tmp_path / "solar.db")
    return str(request.getfixturevalue("server"))


@pytest.fixture
def store(address: str) -> Iterator[Store]:
    with Store.open(address) as store:
        yield store


@pytest.fixture
def sqlite_store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(str(tmp_path / "solar.db")) as store:
        yield store


@pytest.fixture(scope="session")
def make_cells() -> Callable[..., list[Cell]]:
    """Cells of the navigation task, one a seed."""
    card = load_card("nav")

    def make(*seeds: int, method: str = "solar", variant: str = "default") -> list[Cell]:
        return cells(card, method, seeds, variant)

    return make


@pytest.fixture
def me() -> Owner:
    return Owner.current()


@pytest.fixture
def claimed(
    store: Store, make_cells: Callable[..., list[Cell]], me: Owner
) -> tuple[Store, str, int]:
    """A store with one cell that this process computes: (store, hash, attempt)."""
    (cell,) = make_cells(0)
    store.add([cell])
    return store, cell.hash, store.claim(cell.hash, me, 100, {"commit": "c0ffee", "dirty": True})


@pytest.fixture
def commit() -> Callable[..., None]:
    """Commit an iteration, its totals following from its number."""

    def commit(store: Store, hash: str, attempt: int, iteration: int, **rest: Any) -> None:
        totals = {
            "episodes": 10 * iteration,
            "steps": 500 * iteration,
            "simulated_seconds": 25.0 * iteration,
            "seconds": 1.5 * iteration,
        }
        store.commit(hash, attempt, iteration=iteration, **{**totals, **rest})

    return commit


@pytest.fixture
def environment() -> dict[str, str]:
    """For subprocesses: this one's, single-threaded, with the package importable."""
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
