"""Metrics that tell by themselves that something is wrong, with a cell or with its task."""

from __future__ import annotations

import math
from dataclasses import dataclass

from solar_cli.store.store import Store

TRAIN = "train"
"""the split of what learners say"""


@dataclass(frozen=True)
class Sign:
    """A training metric that tells by itself that something is wrong."""

    metric: str
    least: float
    """of what is healthy"""
    most: float
    says: str

    def bad(self, low: float, high: float) -> bool:
        """Whether a value from ``low`` to ``high`` may be unhealthy; one that is no number is."""
        return not (self.least <= low and high <= self.most)


SIGNS = (
    Sign("alive", 1.0, math.inf, "the representation is not healthy"),
    Sign(
        "action_seen_late",
        -math.inf,
        0.0,
        "the newest latents show an earlier action but not the last one: a frame has to show what "
        "the action before it did",
    ),
    Sign(
        "stuck",
        -math.inf,
        0.0,
        "episodes come to rest where they cost more than on their way, whatever their noise: a "
        "wall or another bound of the simulator may hold them",
    ),
    Sign("clipped", -math.inf, 0.5, "most actions are at the card's bound"),
)
"""What methods say of themselves and of their task, and of the actions that they executed."""


def signs(store: Store, cell: str) -> list[str]:
    """What is wrong with one cell, by the newest values of its metrics."""
    rows = store.metrics(hashes=[cell], names=[sign.metric for sign in SIGNS], splits=[TRAIN])
    newest = {row["name"]: row["value"] for row in sorted(rows, key=lambda row: row["iteration"])}
    return [
        sign.says
        for sign in SIGNS
        if (value := newest.get(sign.metric)) is not None and sign.bad(value, value)
    ]
