"""Cells in a store as workers leave them, made by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from solar_cli.settings import Cell
from solar_cli.store.records import Metric, Outcome, Owner
from solar_cli.store.store import Store


def store_attempt(
    store: Store,
    cell: Cell,
    iterations: Sequence[Sequence[Metric]],
    outcome: Outcome | None,
    provenance: Mapping[str, Any],
    error: str | None = None,
    *,
    episodes: int = 10,
    steps: int = 500,
    seconds: float = 2.0,
    target: int = 100,
) -> int:
    """An attempt with the metrics of each iteration from 0 on; its number.

    ``episodes``, ``steps`` and ``seconds`` are those of one iteration. It goes on where ``outcome``
    is None.
    """
    store.add([cell])
    attempt = store.claim(cell.hash, Owner.current(), target, dict(provenance))
    for iteration, metrics in enumerate(iterations):
        store.commit(
            cell.hash,
            attempt,
            iteration=iteration,
            episodes=episodes * iteration,
            steps=steps * iteration,
            simulated_seconds=float(steps * iteration),
            seconds=seconds * iteration,
            metrics=metrics,
        )
    if outcome is not None:
        store.end(cell.hash, attempt, outcome, error)
    return attempt
