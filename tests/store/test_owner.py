"""An owner is a process, not a number; when it is gone its cell is free at once."""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from solar_cli.settings import Cell
from solar_cli.store import owner as module
from solar_cli.store.owner import Owner, is_alive
from solar_cli.store.records import CellBusy, Fenced, Outcome, State
from solar_cli.store.store import Store


@pytest.fixture
def other(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process with a name that makes its line in /proc hard to read."""
    name = tmp_path / "a) Z (b"
    name.symlink_to(shutil.which("sleep") or "/bin/sleep")
    with subprocess.Popen([name, "60"]) as process:
        yield process
        process.kill()


def kill(process: subprocess.Popen[bytes]) -> None:
    """Kill without waiting for it: what is left is a zombie."""
    process.kill()
    stat = Path(f"/proc/{process.pid}/stat")
    while stat.read_text().rpartition(")")[2].split()[0] != "Z":
        time.sleep(0.001)


def test_this_process_is_alive_and_started_before_now(me: Owner) -> None:
    uptime = float(Path("/proc/uptime").read_text().split()[0])
    assert me.pid == os.getpid()
    assert is_alive(me) is True
    assert 0 < me.process_start < uptime
    assert Owner.current() == me


def test_a_killed_process_is_gone_before_and_after_it_is_waited_for(
    other: subprocess.Popen[bytes],
) -> None:
    owner = Owner.of(other.pid)
    assert is_alive(owner) is True
    kill(other)
    assert is_alive(owner) is False
    other.wait()
    assert is_alive(owner) is False


def test_a_stopped_process_is_alive(other: subprocess.Popen[bytes]) -> None:
    owner = Owner.of(other.pid)
    other.send_signal(signal.SIGSTOP)
    assert is_alive(owner) is True


def test_another_process_with_the_same_id_is_not_the_owner(me: Owner) -> None:
    assert is_alive(replace(me, process_start=me.process_start - 0.01)) is False


def test_a_process_of_another_boot_or_without_proc_cannot_be_seen(
    me: Owner, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert is_alive(replace(me, boot="another")) is None
    assert is_alive(replace(me, host="renamed")) is True
    monkeypatch.setattr(module, "PROC", tmp_path)
    assert is_alive(me) is None
    assert is_alive(Owner.current()) is None


def test_a_killed_process_frees_its_cell_at_once_and_only_then(
    store: Store,
    make_cells: Callable[..., list[Cell]],
    me: Owner,
    other: subprocess.Popen[bytes],
) -> None:
    (cell,) = make_cells(0)
    store.add([cell])
    first = store.claim(cell.hash, Owner.of(other.pid), 100, {})
    with pytest.raises(CellBusy):
        store.claim(cell.hash, me, 100, {})
    kill(other)
    assert store.find(cell.hash).state is State.INTERRUPTED
    second = store.claim(cell.hash, me, 100, {})
    assert [a.outcome for a in store.attempts(cell.hash)] == [Outcome.INTERRUPTED, None]
    with pytest.raises(Fenced):
        store.beat(cell.hash, first, "late", 0.0)
    store.beat(cell.hash, second, "working", 0.0)
    assert store.find(cell.hash).state is State.RUNNING


def test_a_killed_owner_does_not_keep_its_cell_from_being_removed(
    sqlite_store: Store, make_cells: Callable[..., list[Cell]], other: subprocess.Popen[bytes]
) -> None:
    (cell,) = make_cells(0)
    sqlite_store.add([cell])
    sqlite_store.claim(cell.hash, Owner.of(other.pid), 100, {})
    kill(other)
    sqlite_store.remove([cell.hash])
    assert sqlite_store.cells() == []
