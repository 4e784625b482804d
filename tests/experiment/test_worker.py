"""The worker's process: its pipe, and what it says of every way to end."""

import os
import select
import signal
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy.exc import OperationalError

from solar_cli.errors import SolarError
from solar_cli.experiment import worker
from solar_cli.experiment.matrix import plan
from solar_cli.experiment.messages import LONGEST, Message
from solar_cli.experiment.scheduler import Event, Result, run
from solar_cli.experiment.worker import Orphaned, Pipe, compute
from solar_cli.reporting.curves import problems
from solar_cli.settings import Cell
from solar_cli.store.owner import Owner
from solar_cli.store.records import Outcome
from solar_cli.store.store import Store

MakeCells = Callable[..., list[Cell]]


@pytest.fixture
def ends() -> Iterator[tuple[int, Pipe]]:
    """A supervisor's end and a worker's."""
    before = signal.getsignal(signal.SIGTERM)
    reader, writer = os.pipe()
    yield reader, Pipe(writer)
    signal.signal(signal.SIGTERM, before)
    # The reader stays open: its end would be the end of the worker, which is this process.


def said(iteration: int = 0, activity: str = "walking") -> Message:
    return Message(iteration, 0, None, activity, 0.5)


@pytest.mark.parametrize(
    "message",
    [Message(3, 40, 0.125, "training", 0.5), Message(0, 0, None, 'a "quoted"\nline\x00é', 0.0)],
)
def test_a_message_survives_its_line(message: Message) -> None:
    line = message.line()
    assert line.count(b"\n") == 1
    assert line.endswith(b"\n")
    assert Message.parse(line) == message


def test_a_line_is_short_enough_to_be_written_whole() -> None:
    longest = said(activity="\N{GRINNING FACE}" * 10_000).line()
    assert len(longest) <= select.PIPE_BUF
    assert len(Message.parse(said(activity="x" * 10_000).line()).activity) == LONGEST


@pytest.mark.parametrize("line", [b"", b"nonsense", b"{}", b'{"iteration": 1, "other": 2}'])
def test_a_line_that_is_no_message_is_refused(line: bytes) -> None:
    with pytest.raises(ValueError, match=r".*"):
        Message.parse(line)


def test_the_pipe_carries_news_at_once_and_repetitions_seldom(ends: tuple[int, Pipe]) -> None:
    reader, pipe = ends
    for message in (said(1), said(1), said(1), said(2), said(2, "resting")):
        pipe.tell(message)
    lines = os.read(reader, 65536).splitlines()
    assert [Message.parse(line) for line in lines] == [said(1), said(2), said(2, "resting")]


def test_a_supervisor_that_does_not_read_cannot_hold_up_a_worker(ends: tuple[int, Pipe]) -> None:
    _, pipe = ends
    for iteration in range(5000):  # far more than a pipe holds
        pipe.tell(said(iteration))


def test_a_worker_without_supervisor_ends_at_the_next_pulse(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Pipe, "_watch", lambda self: None)  # which would end this process
    before = signal.getsignal(signal.SIGTERM)
    reader, writer = os.pipe()
    pipe = Pipe(writer)
    signal.signal(signal.SIGTERM, before)
    pipe.tell(said())
    os.close(reader)
    with pytest.raises(Orphaned):
        pipe.tell(said())  # a repetition, which would not even be sent


def test_a_hanging_worker_without_supervisor_ends_too() -> None:
    program = (
        "import os, sys, time\n"
        "from solar_cli.experiment import worker\n"
        "worker.ORPHAN_SECONDS = 0.1\n"
        "pipe = worker.Pipe(int(sys.argv[1]))\n"
        "time.sleep(280)"
    )
    reader, writer = os.pipe()
    hanging = subprocess.Popen([sys.executable, "-c", program, str(writer)], pass_fds=[writer])
    os.close(writer)
    os.close(reader)
    assert hanging.wait(timeout=250) == 1


def test_a_worker_rounds_no_convolution_and_repeats_itself() -> None:
    """As `tests/methods/test_devices.py` has torch, too; in a process of its own, once."""
    program = (
        "import torch\n"
        "from solar_cli.experiment.worker import prepare_torch\n"
        "assert torch.backends.cudnn.allow_tf32\n"
        "print(prepare_torch('cpu'), torch.backends.cudnn.allow_tf32,\n"
        "      torch.are_deterministic_algorithms_enabled(), torch.get_num_threads())"
    )
    shown = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert shown.stdout.split() == ["cpu", "False", "True", "1"]


def test_sigterm_asks_a_worker_to_stop(ends: tuple[int, Pipe]) -> None:
    _, pipe = ends
    assert not pipe.stopping
    os.kill(os.getpid(), signal.SIGTERM)
    assert pipe.stopping


@pytest.mark.parametrize(
    ("settings", "outcome", "error"),
    [
        ({}, Outcome.FINISHED, None),
        ({"trouble": "raise"}, Outcome.FAILED, "ZeroDivisionError: told to raise"),
        (
            {"trouble": "factorise"},
            Outcome.DIVERGED,
            "iteration 2, 8 episodes: linalg.cholesky: The factorization could not be completed "
            "because the input is not positive-definite (the leading minor of order 1 is not "
            "positive-definite).",
        ),
        (
            {"trouble": "diverge"},
            Outcome.DIVERGED,
            "iteration 2, 8 episodes: told to diverge",
        ),
        (
            {"trouble": "nan"},
            Outcome.DIVERGED,
            "iteration 2, 8 episodes: the mean return of the evaluation episodes is nan",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_an_attempt_ends_with_an_outcome_and_one_line(
    store: Store,
    make_cells: MakeCells,
    ends: tuple[int, Pipe],
    monkeypatch: pytest.MonkeyPatch,
    settings: dict[str, str],
    outcome: Outcome,
    error: str | None,
) -> None:
    monkeypatch.setattr(worker, "prepare_torch", lambda device: device)  # once a process only
    [cell] = make_cells(1, **settings)
    assert compute(store, claimed(store, cell), ends[1]) == (outcome, error)


def test_a_full_disk_interrupts_and_does_not_fail(
    store: Store,
    make_cells: MakeCells,
    ends: tuple[int, Pipe],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(worker, "prepare_torch", lambda device: device)
    monkeypatch.setattr(os, "fsync", full)
    outcome, error = compute(store, claimed(store, make_cells()[0]), ends[1])
    assert outcome is Outcome.INTERRUPTED
    assert error is not None
    assert "No space left on device" in error


def test_a_database_that_fails_interrupts_and_does_not_fail(
    store: Store,
    make_cells: MakeCells,
    ends: tuple[int, Pipe],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def locked(*_: object, **__: object) -> None:
        raise SolarError("locked") from OperationalError("", {}, Exception("locked"))

    monkeypatch.setattr(worker, "prepare_torch", lambda device: device)
    options = claimed(store, make_cells()[0])
    monkeypatch.setattr(Store, "commit", locked)
    assert compute(store, options, ends[1]) == (Outcome.INTERRUPTED, "locked")


@pytest.mark.parametrize("lost", ["episodes/0001-0.npz", "checkpoints/*"])
def test_a_finished_cell_that_has_lost_files_keeps_its_results_and_says_what_to_do(
    store: Store,
    make_cells: MakeCells,
    ends: tuple[int, Pipe],
    monkeypatch: pytest.MonkeyPatch,
    lost: str,
) -> None:
    monkeypatch.setattr(worker, "prepare_torch", lambda device: device)
    [cell] = make_cells()

    def attempt(target: int) -> tuple[Outcome, str]:
        options = claimed(store, cell, target)
        outcome, error = compute(store, options, ends[1])
        store.end(cell.hash, options.attempt, outcome, error)
        return outcome, error or ""

    assert attempt(4) == (Outcome.FINISHED, "")
    rows = store.metrics(hashes=[cell.hash])
    files = {path: path.read_bytes() for path in store.folder(cell.hash).glob(lost)}
    for path in files:
        path.unlink()
    outcome, error = attempt(8)
    assert outcome is Outcome.INTERRUPTED  # what was asked for is not there, but no --retry is due
    assert all(path.name in error for path in files)
    assert "restore" in error
    assert "--redo" in error
    assert "\n" not in error
    assert store.metrics(hashes=[cell.hash]) == rows
    [task] = problems(store)
    assert list(task.curves[0].grid) == [0, 4]
    if "episodes" in lost:  # it can still be content with what it has
        assert attempt(4) == (Outcome.FINISHED, "")
    for path, data in files.items():
        path.write_bytes(data)
    assert attempt(8) == (Outcome.FINISHED, "")


def claimed(store: Store, cell: Cell, target: int = 12) -> Namespace:
    """What the supervisor tells the worker."""
    store.add([cell])
    number = store.claim(cell.hash, Owner.current(), target, {})
    return Namespace(
        cell=cell.hash, attempt=number, target=target, device="cpu", checkpoint_seconds=60.0
    )


def test_workers_of_their_own_process_end_as_they_say(store: Store, make_cells: MakeCells) -> None:
    cells = [
        make_cells()[0],
        make_cells(trouble="raise")[0],
        make_cells(trouble="segfault")[0],
        make_cells(trouble="diverge")[0],
    ]
    results: list[Result] = run(plan(store, cells), store, workers=2)
    assert [result.outcome for result in results] == [
        Outcome.FINISHED,
        Outcome.FAILED,
        Outcome.FAILED,
        Outcome.DIVERGED,
    ]
    assert results[1].cause == "ZeroDivisionError: told to raise"
    assert "SIGSEGV" in results[2].cause
    logs = [(store.folder(cell.hash) / "log.txt").read_text() for cell in cells]
    assert "Traceback" not in logs[0]
    assert "Traceback (most recent call last)" in logs[1]
    assert "in _fail" in logs[2]  # the stack of the crash
    provenance = store.attempts(cells[0].hash)[-1].provenance
    assert {"commit", "dirty", "packages", "hardware", "command"} <= set(provenance)


def test_a_stopped_worker_saves_and_the_next_run_goes_on(
    store: Store, make_cells: MakeCells, tmp_path: Path
) -> None:
    hold = tmp_path / "hold"
    hold.touch()
    [cell] = make_cells(hold=str(hold))
    held: list[Event] = []

    def stop(event: Event) -> None:
        if event.message and event.message.activity == "held":
            held.append(event)
            if len(held) == 1:
                os.kill(os.getpid(), signal.SIGINT)

    [result] = run(plan(store, [cell]), store, report=stop)
    assert result.outcome is Outcome.INTERRUPTED
    assert "stopped on request in iteration 2" in result.cause
    assert not store.checkpoints(cell.hash)[0].complete
    hold.unlink()
    [result] = run(plan(store, [cell]), store)
    assert result.finished
