"""Where workers run. An engine starts a worker and lets it be watched; the first is this machine.

A worker runs in an environment that is the same for every cell, whatever the user's shell has set:
the same cell gives the same bits for any number of workers beside it.
"""

from __future__ import annotations

import os
import selectors
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from solar_cli.experiment.messages import Message

ENVIRONMENT = {
    # One thread a worker, so that the cores go to cells and sums are made in one order.
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    # The same code path for every alignment of the data: the same bits in every process.
    "MKL_CBWR": "AUTO",
    "CUBLAS_WORKSPACE_CONFIG": ":4096:8",
    "PYTHONHASHSEED": "0",
    # Software rendering within the calling thread: small pictures gain nothing from others.
    "LP_NUM_THREADS": "0",
    # Keep freed megabytes: batches of frames are made anew in every step, and fresh pages are slow.
    "MALLOC_MMAP_THRESHOLD_": str(32 * 2**20),
    "MALLOC_TRIM_THRESHOLD_": str(256 * 2**20),
    # A crash in native code leaves its stack in the log.
    "PYTHONFAULTHANDLER": "1",
}


@dataclass(frozen=True)
class Order:
    """What a worker is told."""

    address: str
    """of the database; may hold a password"""
    home: Path
    """folder of the cells' files"""
    cell: str
    """hash"""
    attempt: int
    target: int
    """episodes to stop at"""
    device: str
    checkpoint_seconds: float
    log: Path


class Job(Protocol):
    """A worker that was started."""

    def messages(self) -> list[Message]:
        """What it has said since the last call; never waits."""

    def exit_code(self) -> int | None:
        """None while it runs; minus the signal's number when one ended it."""

    def stop(self) -> None:
        """Ask it to save its state and end."""

    def kill(self) -> None:
        """End it at once."""


class Engine(Protocol):
    """Starts workers somewhere."""

    def start(self, order: Order) -> Job:
        """Start a worker. Raises `OSError` where that is impossible."""

    def wait(self, jobs: Sequence[Job], seconds: float) -> None:
        """Return when a job has something to say or has ended, at the latest after ``seconds``."""


class LocalJob:
    """A process of this machine."""

    def __init__(self, process: subprocess.Popen[bytes], pipe: int) -> None:
        self._process = process
        self._rest = b""
        self.pipe = pipe
        """read end of the worker's pipe"""
        self.open = True

    def messages(self) -> list[Message]:
        """As `Job.messages`."""
        while self.open:
            try:
                data = os.read(self.pipe, 65536)
            except BlockingIOError:
                break
            self._rest += data
            if not data:
                self._close()
        *lines, self._rest = self._rest.split(b"\n")
        return [Message.parse(line) for line in lines]

    def exit_code(self) -> int | None:
        """As `Job.exit_code`."""
        return self._process.poll()

    def stop(self) -> None:
        """As `Job.stop`."""
        self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """As `Job.kill`."""
        self._process.kill()
        self._process.wait()
        self._close()

    def _close(self) -> None:
        if self.open:
            os.close(self.pipe)
            self.open = False


class LocalEngine:
    """Workers are processes of this machine."""

    def __init__(
        self, command: Sequence[str] = (sys.executable, "-m", "solar_cli.experiment.worker")
    ) -> None:
        self._command = command

    def start(self, order: Order) -> LocalJob:
        """As `Engine.start`."""
        reader, writer = os.pipe()
        os.set_blocking(reader, False)
        order.log.parent.mkdir(parents=True, exist_ok=True)
        try:
            with order.log.open("ab") as log:
                process = subprocess.Popen(
                    [*self._command, *_arguments(order), "--pipe", str(writer)],
                    env=_environment(os.environ, order),
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    pass_fds=[writer],
                    # Ctrl-C is for the scheduler, which asks its workers to stop.
                    start_new_session=True,
                )
        except OSError:
            os.close(reader)
            raise
        finally:
            os.close(writer)
        return LocalJob(process, reader)

    def wait(self, jobs: Sequence[Job], seconds: float) -> None:
        """As `Engine.wait`."""
        with selectors.DefaultSelector() as selector:
            for job in jobs:
                if isinstance(job, LocalJob) and job.open:
                    selector.register(job.pipe, selectors.EVENT_READ)
            selector.select(seconds)


def _arguments(order: Order) -> list[str]:
    options = {
        "--cell": order.cell,
        "--attempt": order.attempt,
        "--target": order.target,
        "--device": order.device,
        "--checkpoint-seconds": order.checkpoint_seconds,
    }
    return [text for option, value in options.items() for text in (option, str(value))]


def _environment(own: Mapping[str, str], order: Order) -> dict[str, str]:
    # The database goes this way because every user can read the arguments of every process, and an
    # address may hold a password.
    where = {"SOLAR_DB": order.address, "SOLAR_HOME": str(order.home)}
    return {**own, **ENVIRONMENT, **where}
