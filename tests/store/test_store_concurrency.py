"""Several processes at one database: nothing fails, nothing is lost, nothing is seen half."""

import multiprocessing
import sqlite3
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, func, select

from solar_cli.settings import Cell, cells, load_card
from solar_cli.store.address import locate
from solar_cli.store.database import Database
from solar_cli.store.migrate import upgrade
from solar_cli.store.owner import Owner
from solar_cli.store.records import CellBusy, Metric
from solar_cli.store.schema import CellRow
from solar_cli.store.store import Store

# Processes of their own, not forks of this one, which may hold threads and connections.
processes = multiprocessing.get_context("forkserver")
processes.set_forkserver_preload(["solar_cli.store.store", "alembic.command"])
WRITERS, ITERATIONS, METRICS = 8, 8, 10


def nav(seed: int) -> Cell:
    return cells(load_card("nav"), "solar", [seed])[0]


def together(work: Callable[..., Any], *arguments: tuple[Any, ...]) -> list[Any]:
    """Run one process for each tuple of arguments, all starting at once; their answers."""
    barrier = processes.Barrier(len(arguments))
    answers = processes.SimpleQueue()
    started = [
        processes.Process(target=_answer, args=(work, answers, barrier, *each), daemon=True)
        for each in arguments
    ]
    for process in started:
        process.start()
    found = [answers.get() for _ in started]
    for process in started:
        process.join()
    return found


def _answer(work: Callable[..., Any], answers: Any, barrier: Barrier, *arguments: Any) -> None:
    try:
        answers.put(work(barrier, *arguments))
    except BaseException as error:
        answers.put(f"{type(error).__name__}: {error}")


def write(barrier: Barrier, address: str, seed: int) -> int:
    """Compute a cell: a heartbeat and a commit an iteration."""
    cell = nav(seed)
    with Store.open(address) as store:
        barrier.wait()
        store.add([cell])
        attempt = store.claim(cell.hash, Owner.current(), 1, {})
        for iteration in range(ITERATIONS):
            store.beat(cell.hash, attempt, "writing", iteration / ITERATIONS)
            store.commit(
                cell.hash,
                attempt,
                iteration=iteration,
                episodes=iteration,
                steps=0,
                simulated_seconds=0.0,
                seconds=0.0,
                metrics=[Metric(f"m{i}", float(seed)) for i in range(METRICS)],
            )
    return 0


def read(barrier: Barrier, address: str) -> int:
    """Read until all is there; the number of iterations that were ever seen in part."""
    torn = 0
    with Store.open(address, read_only=True) as store:
        barrier.wait()
        for _ in range(600):
            rows = Counter((row["cell"], row["iteration"]) for row in store.metrics())
            torn += sum(count != METRICS for count in rows.values())
            if len(rows) == WRITERS * ITERATIONS:
                return torn
            time.sleep(0.1)
    raise TimeoutError("the writers did not write all")


def test_eight_writers_and_a_reader_lose_nothing_and_see_no_half_iteration(tmp_path: Path) -> None:
    address = str(tmp_path / "solar.db")
    Store.open(address).close()

    assert together(_turn, *((address, seed) for seed in range(WRITERS + 1))) == [0] * (WRITERS + 1)

    with Store.open(address) as store:
        rows = store.metrics()
        assert len(rows) == WRITERS * ITERATIONS * METRICS
        assert all(row["value"] == row["seed"] for row in rows)
        assert [r.iteration for r in store.cells()] == [ITERATIONS - 1] * WRITERS
        assert store.diagnose()["integrity"] == "ok"


def _turn(barrier: Barrier, address: str, seed: int) -> int:
    """Eight write and the ninth reads."""
    return write(barrier, address, seed) if seed < WRITERS else read(barrier, address)


def claim(barrier: Barrier, address: str) -> str:
    with Store.open(address) as store:
        barrier.wait()
        try:
            store.claim(nav(0).hash, Owner.current(), 1, {})
        except CellBusy:
            answer = "busy"
        else:
            answer = "mine"
        barrier.wait()  # live until all have asked
        return answer


def test_of_many_claims_at_once_one_gets_the_cell(tmp_path: Path) -> None:
    address = str(tmp_path / "solar.db")
    with Store.open(address) as store:
        store.add([nav(0)])
    assert sorted(together(claim, *[(address,)] * 4)) == ["busy"] * 3 + ["mine"]


def create(barrier: Barrier, address: str, seed: int) -> str:
    barrier.wait()
    with Store.open(address) as store:
        store.add([nav(seed)])
    return "opened"


def test_of_many_that_open_an_empty_path_one_creates_and_all_go_on(tmp_path: Path) -> None:
    address = str(tmp_path / "new" / "folder" / "solar.db")
    assert together(create, *((address, seed) for seed in range(4))) == ["opened"] * 4
    with Store.open(address, read_only=True) as store:
        assert [record.cell.seed for record in store.cells()] == [0, 1, 2, 3]
    with sqlite3.connect(address) as connection:
        assert len(connection.execute("SELECT * FROM alembic_version").fetchall()) == 1


def test_of_many_that_open_an_empty_server_one_creates_and_all_go_on(
    postgresql: str,
) -> None:
    address = postgresql.replace("/postgres?", "/created?")
    server = create_engine(str(locate(postgresql).place), isolation_level="AUTOCOMMIT")
    with server.connect() as connection:
        connection.exec_driver_sql("DROP DATABASE IF EXISTS created WITH (FORCE)")
        connection.exec_driver_sql("CREATE DATABASE created")
    server.dispose()
    assert together(create, *((address, seed) for seed in range(4))) == ["opened"] * 4
    with Store.open(address, read_only=True) as store:
        assert [record.cell.seed for record in store.cells()] == [0, 1, 2, 3]


def test_who_opens_while_another_creates_waits_for_it(address: str) -> None:
    first = Database(locate(address), read_only=False)
    with ThreadPoolExecutor(1) as threads:
        with first.altering() as connection:
            upgrade(connection)
            second = threads.submit(Store.open, address)
            with pytest.raises(TimeoutError):
                second.result(timeout=0.3)
        with second.result(timeout=200) as store:
            assert store.cells() == []
    first.close()


def test_all_statements_of_a_reading_see_one_moment(store: Store) -> None:
    # SQLite lets no writer commit during a reading, so there the writer waits for its end.
    count = select(func.count()).select_from(CellRow)
    with ThreadPoolExecutor(1) as threads:
        with store._database.reading() as session:
            assert session.scalars(count).one() == 0
            adding = threads.submit(store.add, [nav(0)])
            wait([adding], timeout=0.3)
            assert session.scalars(count).one() == 0
        adding.result(timeout=200)
    assert len(store.cells()) == 1


def test_writes_to_one_cell_wait_for_each_other(claimed: tuple[Store, str, int]) -> None:
    store, hash, attempt = claimed
    with ThreadPoolExecutor(1) as threads:
        with store._database.writing() as session:
            store._locked(session, hash)
            later = threads.submit(store.beat, hash, attempt, "later", 0.5)
            with pytest.raises(TimeoutError):
                later.result(timeout=0.3)
        later.result(timeout=200)
    assert store.attempts(hash)[0].activity == "later"


def add(barrier: Barrier, address: str) -> str:
    with Store.open(address) as store:
        barrier.wait()
        store.add([nav(seed) for seed in range(50)])
    return "added"


def test_of_many_that_add_the_same_cells_none_fails(address: str) -> None:
    Store.open(address).close()
    assert together(add, *[(address,)] * 3) == ["added"] * 3
    with Store.open(address) as store:
        assert len(store.cells()) == 50
