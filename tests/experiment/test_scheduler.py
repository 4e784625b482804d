"""The scheduler: every cell ends with an outcome, whatever its worker does."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from solar_cli.experiment import scheduler, supervision
from solar_cli.experiment.engine import LocalEngine
from solar_cli.experiment.matrix import Action, Plan, plan
from solar_cli.experiment.scheduler import Event, Result, default_workers, run
from solar_cli.settings import Cell
from solar_cli.store.owner import Owner
from solar_cli.store.records import Outcome, State
from solar_cli.store.store import Store

STUB = LocalEngine([sys.executable, str(Path(__file__).parent / "stub_worker.py")])
MakeCells = Callable[..., list[Cell]]


@pytest.fixture
def stub(
    store: Store, make_cells: MakeCells, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., list[Result]]:
    """Run one cell for each word, which says what its worker does."""

    def run_stubs(
        *words: str, report: Callable[[Event], None] = lambda _: None, workers: int = 2
    ) -> list[Result]:
        cells = make_cells(len(words))
        tell_stubs(monkeypatch, cells, *words)
        plans = plan(store, cells)
        return run(plans, store, engine=STUB, workers=workers, report=report)

    return run_stubs


def tell_stubs(monkeypatch: pytest.MonkeyPatch, cells: list[Cell], *words: str) -> None:
    told = {cell.hash: word for cell, word in zip(cells, words, strict=True)}
    monkeypatch.setenv("STUB", json.dumps(told))


def test_a_worker_that_dies_touches_no_other_cell(
    store: Store, stub: Callable[..., list[Result]]
) -> None:
    results = stub("finish", "exit:3", "signal:SIGKILL", "signal:SIGSEGV", "finish")
    assert [result.outcome for result in results] == [
        Outcome.FINISHED,
        Outcome.FAILED,
        Outcome.INTERRUPTED,  # killed from outside: the next run takes it up
        Outcome.FAILED,
        Outcome.FINISHED,
    ]
    assert [result.finished for result in results] == [True, False, False, False, True]
    for result, word in zip(results[1:4], ("code 3", "SIGKILL", "SIGSEGV"), strict=True):
        assert word in result.cause
        attempt = store.attempts(result.plan.cell.hash)[-1]
        assert (attempt.outcome, attempt.error) == (result.outcome, result.cause)
    again = plan(store, [result.plan.cell for result in results])
    assert [p.action for p in again] == [
        Action.SKIP,
        Action.BLOCKED,
        Action.RESUME,
        Action.BLOCKED,
        Action.SKIP,
    ]


def test_a_finished_matrix_starts_no_worker(
    store: Store, stub: Callable[..., list[Result]]
) -> None:
    stub("finish")
    events: list[Event] = []
    [result] = stub("finish", report=events.append)
    assert result.finished
    assert events == []
    assert len(store.attempts(result.plan.cell.hash)) == 1


def test_no_more_workers_at_a_time_than_asked_for(stub: Callable[..., list[Result]]) -> None:
    running, most = set(), 0

    def count(event: Event) -> None:
        nonlocal most
        (running.discard if event.kind == "ended" else running.add)(event.plan.cell.hash)
        most = max(most, len(running))

    results = stub("finish:0.3", "finish:0.3", "finish:0.3", report=count, workers=2)
    assert all(result.finished for result in results)
    assert most == 2


def test_a_stop_lets_workers_save_and_starts_no_other(
    store: Store, stub: Callable[..., list[Result]]
) -> None:
    def stop(event: Event) -> None:
        if event.message and event.message.activity == "working":
            os.kill(os.getpid(), signal.SIGTERM)

    results = stub("finish:200", "finish", report=stop, workers=1)
    assert [result.outcome for result in results] == [Outcome.INTERRUPTED, None]
    assert "stopped" in results[1].cause
    assert not store.cells(hashes=[results[1].plan.cell.hash])
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL  # as it was before


def test_a_run_that_nobody_reads_stops_and_says_so(
    store: Store, stub: Callable[..., list[Result]]
) -> None:
    def closed(event: Event) -> None:
        if event.message:
            raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        stub("finish:200", report=closed)
    [record] = store.cells()
    assert record.last_attempt is not None
    assert record.last_attempt.outcome is Outcome.INTERRUPTED
    assert record.last_attempt.error == "the run was stopped: nobody reads its output"


def test_the_signals_of_one_request_count_once(
    store: Store, stub: Callable[..., list[Result]]
) -> None:
    """A closing terminal sends SIGHUP twice, a launcher forwards what the terminal has sent."""

    news: list[Event] = []

    def hang_up(event: Event) -> None:
        if event.message and event.message.activity == "working":
            news.append(event)
            if len(news) == 1:
                os.kill(os.getpid(), signal.SIGHUP)
                os.kill(os.getpid(), signal.SIGTERM)

    [result] = stub("finish:200", report=hang_up)
    assert (result.outcome, result.cause) == (Outcome.INTERRUPTED, "")  # as the worker stored it


def test_a_stop_before_a_worker_can_listen_ends_it(stub: Callable[..., list[Result]]) -> None:
    def stop(event: Event) -> None:
        if event.message and event.message.activity == "importing":
            os.kill(os.getpid(), signal.SIGTERM)

    [result] = stub("early", report=stop)
    assert result.outcome is Outcome.INTERRUPTED
    assert result.cause == "stopped on request while it started"


def test_a_second_stop_ends_workers_that_do_not_listen(
    store: Store, stub: Callable[..., list[Result]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervision, "BEAT_SECONDS", 0.0)
    stops = 0
    whole = Store.beat

    def beat(self: Store, hash: str, attempt: int, activity: str, fraction: float) -> None:
        nonlocal stops
        whole(self, hash, attempt, activity, fraction)
        if activity == "deaf":
            stops += 1
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Store, "beat", beat)
    [result] = stub("deaf")
    assert stops >= 2
    assert (result.outcome, result.cause) == (Outcome.INTERRUPTED, "stopped at once on request")
    assert store.find(result.plan.cell.hash).state is State.INTERRUPTED


def test_a_run_in_the_background_leaves_ctrl_c_to_others(
    stub: Callable[..., list[Result]],
) -> None:
    """A shell without job control starts it so that it ignores what the terminal sends."""

    def interrupt(event: Event) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    [result] = stub("finish", report=interrupt)
    assert result.outcome is Outcome.FINISHED


def test_heartbeats_carry_what_the_worker_does(
    store: Store, stub: Callable[..., list[Result]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervision, "BEAT_SECONDS", 0.0)
    beats = []
    whole = Store.beat

    def beat(self: Store, hash: str, attempt: int, activity: str, fraction: float) -> None:
        whole(self, hash, attempt, activity, fraction)
        beats.append((activity, fraction))
        if activity == "working" and beats.count(beats[-1]) == 1:
            os.kill(os.getpid(), signal.SIGTERM)  # it works until this was seen

    monkeypatch.setattr(Store, "beat", beat)
    [result] = stub("finish:200")
    assert ("working", 0.5) in beats
    attempt = store.attempts(result.plan.cell.hash)[-1]
    assert (attempt.activity, attempt.fraction) == beats[-1]
    assert attempt.heartbeat > attempt.started


def test_an_end_reports_the_last_message_and_time_left_follows_the_pace(
    stub: Callable[..., list[Result]],
) -> None:
    events: list[Event] = []
    stub("finish:0.5", report=events.append)
    assert [event.kind for event in (events[0], events[-1])] == ["started", "ended"]
    first = [event for event in events if event.message and event.message.episodes == 0]
    assert all(event.seconds_left is None for event in first)  # no such cell has ever finished
    last = events[-1].message
    assert last is not None
    assert (last.headline, last.episodes) == (0.5, 12)
    assert events[-2].seconds_left == 0.0


def test_a_cell_that_was_taken_over_is_left_to_its_new_owner(
    store: Store, stub: Callable[..., list[Result]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervision, "BEAT_SECONDS", 0.0)
    [result] = stub("lose")
    assert result.outcome is None
    assert not result.finished
    log = (store.folder(result.plan.cell.hash) / "log.txt").read_text()
    assert "unharmed" not in log  # its worker, which would go on for minutes, is killed
    assert len(store.attempts(result.plan.cell.hash)) == 2


def test_a_cell_that_another_run_computes_is_left_to_it(
    store: Store, make_cells: MakeCells, monkeypatch: pytest.MonkeyPatch
) -> None:
    [mine, theirs] = make_cells(2)
    plans = plan(store, [mine, theirs])
    store.add([theirs])
    number = store.claim(theirs.hash, Owner.of(os.getppid()), 16, {})

    def finish_theirs(event: Event) -> None:
        if event.kind == "ended" and event.plan.cell == mine:
            store.commit(
                theirs.hash,
                number,
                iteration=1,
                episodes=16,
                steps=0,
                simulated_seconds=0.0,
                seconds=1.0,
            )
            store.end(theirs.hash, number, Outcome.FINISHED)

    tell_stubs(monkeypatch, [mine, theirs], "finish", "exit:9")
    results = run(plans, store, engine=STUB, workers=1, report=finish_theirs)
    assert results[0].outcome is Outcome.FINISHED
    assert results[1].outcome is None  # not by this run ...
    assert results[1].plan.action in (Action.SKIP, Action.STALE)  # ... but it is there
    assert results[1].finished
    assert len(store.attempts(theirs.hash)) == 1


def test_redo_is_for_what_was_there_when_it_was_planned(
    store: Store, make_cells: MakeCells, stub: Callable[..., list[Result]]
) -> None:
    [result] = stub("finish")
    cell = result.plan.cell
    plans = plan(store, [cell], redo=True)
    assert plans[0].action is Action.REDO
    number = store.claim(cell.hash, Owner.current(), 16, scheduler.provenance("cpu"))
    store.end(cell.hash, number, Outcome.FINISHED)
    [result] = run(plans, store, engine=STUB)
    assert result.plan.action in (Action.SKIP, Action.STALE)
    assert len(store.attempts(cell.hash)) == 2


def test_redo_discards_what_was_stored(store: Store, stub: Callable[..., list[Result]]) -> None:
    [result] = stub("finish")
    cell = result.plan.cell
    leftover = store.folder(cell.hash) / "episodes" / "0001-0.npz"
    leftover.parent.mkdir()
    leftover.touch()
    [result] = run(plan(store, [cell], redo=True), store, engine=STUB)
    assert result.outcome is Outcome.FINISHED
    assert [attempt.number for attempt in store.attempts(cell.hash)] == [1]
    assert not leftover.exists()


def test_workers_get_one_thread_and_no_password_in_their_arguments(
    store: Store, stub: Callable[..., list[Result]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    [result] = stub("finish")
    log = (store.folder(result.plan.cell.hash) / "log.txt").read_text()
    assert "threads 1" in log
    assert store.address not in log  # an address may hold a password


def test_a_worker_that_cannot_be_started_is_an_outcome(store: Store, make_cells: MakeCells) -> None:
    plans = plan(store, make_cells(1))
    [result] = run(plans, store, engine=LocalEngine(["/no/such/python"]))
    assert result.outcome is Outcome.INTERRUPTED
    assert "no worker can be started" in result.cause


@pytest.mark.parametrize(
    ("available", "cores", "pending", "expected"),
    [
        (8 * 2**30, 4, 10, 4),
        (8 * 2**30, 4, 3, 3),
        (4 * 2**30 + 5, 4, 10, 2),
        (2**20, 4, 10, 1),
        (None, 4, 10, 4),
    ],
)
def test_workers_fit_cores_memory_and_work(
    monkeypatch: pytest.MonkeyPatch,
    available: int | None,
    cores: int,
    pending: int,
    expected: int,
) -> None:
    monkeypatch.setattr(scheduler, "memory_bytes", lambda _: available)
    monkeypatch.setattr(scheduler, "cores", lambda: cores)
    assert default_workers(pending) == expected


def test_planning_and_scheduling_import_nothing_heavy() -> None:
    code = (
        "import sys, solar_cli.experiment.scheduler, solar_cli.experiment.estimates\n"
        "from solar_cli.store.store import Store\n"
        "heavy = {'torch', 'scipy', 'matplotlib', 'gymnasium', 'pandas'} & set(sys.modules)\n"
        "sys.exit(f'imported: {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_plans_without_work_are_results_as_they_are(store: Store, make_cells: MakeCells) -> None:
    [cell] = make_cells(1)
    plans = [Plan(cell, 16, action, "why") for action in (Action.SKIP, Action.BLOCKED)]
    assert [result.finished for result in run(plans, store)] == [True, False]
