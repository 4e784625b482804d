"""What a report shows of a finished cell: its policy at work, and frames as its model sees them."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solar_cli.episodes import Episodes
from solar_cli.methods import Learner
from solar_cli.store.store import Store

SHOWN = 6
"""episodes of the animation"""
RECONSTRUCTED = 8
"""frames beside their reconstructions"""


def exhibit(
    store: Store, cell: str, attempt: int, iteration: int, kind: str, shown: Episodes, of: Learner
) -> None:
    """Store the artifacts ``animation`` and, for a learner that reconstructs, ``reconstruction``.

    ``animation.npz`` has ``frames`` (K, T+1, *frame) and ``kind``, what they are (``image`` or
    ``state``); ``reconstruction.npz`` has ``original`` and ``reconstruction`` (M, *frame).
    """
    episodes = shown[:SHOWN]
    exhibits: dict[str, dict[str, NDArray[Any]]] = {
        "animation": {"frames": episodes.frames, "kind": np.array(kind)}
    }
    seen = of.reconstruct(episodes)
    if seen is not None:
        rows = _spread(episodes.frames.shape[:2])
        exhibits["reconstruction"] = {
            "original": episodes.frames[rows],
            "reconstruction": seen[rows],
        }
    for name, arrays in exhibits.items():
        path = store.folder(cell) / f"{name}.npz"
        beside = path.with_name(f".{name}.{os.getpid()}.npz")
        np.savez_compressed(beside, allow_pickle=False, **arrays)
        beside.replace(path)  # whole or not at all
        store.add_artifact(cell, attempt, name, path, iteration)


def _spread(shape: tuple[int, ...]) -> tuple[NDArray[np.intp], ...]:
    """Indices of a few frames, spread over episodes and times so that they differ."""
    chosen = np.linspace(0, shape[0] * shape[1] - 1, RECONSTRUCTED).round().astype(np.intp)
    return tuple(np.unravel_index(np.unique(chosen), shape))
