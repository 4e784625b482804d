"""The command line as a user meets it, and what a database of tests holds."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stored_cells import store_attempt

from solar_cli.settings import Cell
from solar_cli.store.records import Metric, Outcome
from solar_cli.store.store import Store

HOSTILE = "boom \x1b[31mred\x1b[0m [bold]not bold[/bold]\r\nsecond line\x07"
"""An error message that would colour the screen, ring the bell and be read as markup."""


@dataclass(frozen=True)
class Done:
    """What a command printed, and its exit code."""

    code: int
    out: str
    err: str

    def refused(self, *parts: str) -> None:
        """Bad input: exit code 2, one line on standard error that says all of ``parts``."""
        assert self.code == 2, self
        assert self.err.count("\n") == 1, self.err
        assert "Traceback" not in self.err
        for part in parts:
            assert part in self.err, self.err


Solar = Callable[..., Done]


@dataclass(frozen=True)
class Stored:
    """A database, and its cells by what they are."""

    db: Path
    finished: Cell
    second: Cell
    stale: Cell
    diverged: Cell
    failed: Cell
    interrupted: Cell
    pending: Cell


def compute(
    store: Store,
    cell: Cell,
    distances: list[float],
    outcome: Outcome,
    provenance: dict[str, object],
    error: str | None = None,
) -> None:
    """Store what a worker would have stored, 8 episodes an iteration."""
    iterations = [
        [
            Metric("final_distance", distance, "noise_free", np.full(8, distance)),
            Metric("return", -distance, "noise_free", np.full(8, -distance)),
            Metric("elbo", float("-inf"), "train"),
        ]
        for distance in distances
    ]
    pace: dict[str, Any] = {"episodes": 8, "steps": 80, "seconds": 2.5, "target": 16}
    store_attempt(store, cell, iterations, outcome, provenance, error, **pace)
