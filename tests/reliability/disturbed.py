"""A matrix that is run and killed from outside, as a user's is."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bits import fingerprint

from solar_cli.store.store import Store

HERE = Path(__file__).parent
PATIENCE = 900.0
"""seconds for what takes a few on a machine of its own: a limit for what hangs, no measurement"""


@dataclass
class Matrix:
    """One database, and the processes that were started on it."""

    folder: Path
    seeds: int = 1
    task: str = "nav"
    method: str = "solar"
    kills: int = 0
    schedulers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def db(self) -> str:
        return str(self.folder / "solar.db")

    @property
    def results(self) -> Path:
        return self.folder / "results.json"

    def start(
        self, *, die: str = "", checkpoint_seconds: float = 0.0, sets: Sequence[str] = ()
    ) -> subprocess.Popen[bytes]:
        """Start ``solar run``'s scheduler; ``die`` says where the worker kills, see mortal_worker.

        Without pause between them, there is a checkpoint at every pulse.
        """
        settings = [self.db, self.task, str(self.seeds), str(checkpoint_seconds)]
        settings += [str(self.results), *sets]
        scheduler = subprocess.Popen(
            [sys.executable, str(HERE / "drive.py"), *settings],
            env=os.environ
            | {"DIE": die, "METHOD": self.method, "KILLS": str(self.folder / "kills.txt")},
        )
        self.schedulers.append(scheduler)
        return scheduler

    def die(self, where: str) -> None:
        """Run until the kill happens; fails when it does not."""
        scheduler = self.start(die=where)
        scheduler.wait(timeout=PATIENCE)
        done = (self.folder / "kills.txt").read_text().split()
        assert len(done) == self.kills + 1, f"no kill at {where}"
        self.kills += 1

    def die_after(self, seconds: float, who: str) -> None:
        """Kill -9 ``who`` when the first worker has computed for a time.

        ``who`` is ``workers``, ``scheduler`` or ``all``; nobody is left to kill after the end.
        """
        scheduler = self._start_and_let_compute(seconds)
        victims = [] if who == "scheduler" else children(scheduler.pid)
        if who != "workers" and scheduler.poll() is None:
            victims.append(scheduler.pid)
        for pid in victims:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                self.kills += 1
        scheduler.wait(timeout=PATIENCE)

    def stop_after(self, seconds: float) -> bool:
        """Ask it to stop when the first worker has computed for a time; whether it was not done."""
        scheduler = self._start_and_let_compute(seconds)
        scheduler.terminate()
        return scheduler.wait(timeout=PATIENCE) == 1

    def _start_and_let_compute(self, seconds: float) -> subprocess.Popen[bytes]:
        scheduler = self.start()
        started = time.time()
        while scheduler.poll() is None and not self._computing(started):
            time.sleep(0.02)
        time.sleep(seconds)
        return scheduler

    def _computing(self, since: float) -> bool:
        """Whether a worker has left its imports behind, and written something."""
        files = list(self.folder.glob("cells/*/episodes/*"))
        files += list(self.folder.glob("cells/*/checkpoints/*"))
        with suppress(FileNotFoundError):  # written files come and go
            return any(file.stat().st_mtime > since for file in files)
        return True

    def finish(self) -> list[dict[str, Any]]:
        """The next run, which nothing disturbs; what became of each cell."""
        self.results.unlink(missing_ok=True)
        code = self.start(checkpoint_seconds=60.0).wait(timeout=PATIENCE)
        results: list[dict[str, Any]] = json.loads(self.results.read_text())
        assert (code == 0) == all(result["finished"] for result in results)
        return results

    def fingerprints(self) -> dict[str, dict[str, str]]:
        with Store.open(self.db) as store:
            return {r.hash: fingerprint(store, r.hash) for r in store.cells()}


def children(pid: int) -> list[int]:
    """The workers of a scheduler."""
    try:
        return [int(c) for c in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except FileNotFoundError:
        return []


@dataclass(frozen=True)
class Undisturbed:
    """A run of two seeds that nothing interrupted."""

    fingerprints: dict[str, dict[str, str]]
    seconds: float
    """of computing, without the start of the processes"""
