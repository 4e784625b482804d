"""A matrix that is run and killed from outside, as a user's is."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "experiment"))  # where `bits` is

from bits import fingerprint  # noqa: E402

from solar_cli.store.store import Store  # noqa: E402


@dataclass
class Matrix:
    """One database, and the processes that were started on it."""

    folder: Path
    seeds: int = 1
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
        settings = [self.db, str(self.seeds), str(checkpoint_seconds), str(self.results), *sets]
        scheduler = subprocess.Popen(
            [sys.executable, str(HERE / "drive.py"), *settings],
            env=os.environ | {"DIE": die, "KILLS": str(self.folder / "kills.txt")},
        )
        self.schedulers.append(scheduler)
        return scheduler

    def die(self, where: str) -> None:
        """Run until the kill happens; fails when it does not."""
        scheduler = self.start(die=where)
        scheduler.wait(timeout=120)
        done = (self.folder / "kills.txt").read_text().split()
        assert len(done) == self.kills + 1, f"no kill at {where}"
        self.kills += 1

    def die_after(self, seconds: float, who: str) -> bool:
        """Kill -9 ``who`` at that age of the run; False when it had finished before."""
        scheduler = self.start()
        time.sleep(seconds)
        workers = children(scheduler.pid)
        if scheduler.poll() is not None:
            return False
        victims = workers * (who in ("workers", "all")) + [scheduler.pid] * (
            who in ("scheduler", "all")
        )
        for pid in victims:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        scheduler.wait(timeout=120)
        self.kills += 1
        return True

    def finish(self) -> list[dict[str, Any]]:
        """The next run, which nothing disturbs; what became of each cell."""
        self.start(checkpoint_seconds=60.0).wait(timeout=300)
        results: list[dict[str, Any]] = json.loads(self.results.read_text())
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


@pytest.fixture
def matrix(tmp_path: Path) -> Iterator[Callable[[int], Matrix]]:
    made: list[Matrix] = []

    def make(seeds: int) -> Matrix:
        made.append(Matrix(tmp_path / str(len(made)), seeds))
        made[-1].folder.mkdir()
        return made[-1]

    yield make
    for scheduler in [s for one in made for s in one.schedulers]:
        scheduler.kill()
        scheduler.wait()


@dataclass(frozen=True)
class Undisturbed:
    """A run of two seeds that nothing interrupted."""

    fingerprints: dict[str, dict[str, str]]
    seconds: float


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    quiet = Matrix(tmp_path_factory.mktemp("undisturbed"), seeds=2)
    started = time.monotonic()
    assert all(result["finished"] for result in quiet.finish())
    return Undisturbed(quiet.fingerprints(), time.monotonic() - started)
