"""What a report shows of a finished cell: its policy at work, and frames as its model sees them.

All of it is of the last evaluation, and so is the truth that the latents stand beside.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solar_cli.episodes import Evaluation
from solar_cli.methods import Foreseeing, Learner
from solar_cli.store.store import Store

SHOWN = 6
"""episodes of the animation"""
RECONSTRUCTED = 8
"""frames beside their reconstructions, or beside predictions"""
POINTS = 2000
"""latents, at most"""

Arrays = dict[str, NDArray[Any]]


def exhibit(
    store: Store,
    cell: str,
    attempt: int,
    iteration: int,
    shown: NDArray[np.uint8] | None,
    judged: Evaluation,
    of: Learner,
) -> None:
    """Store the artifacts ``animation``, of a task that can be ``shown``, and of a learner that has
    them the others.

    ``animation.npz`` has ``frames`` (K, T+1, C, H, W) uint8; ``reconstruction.npz`` has
    ``original`` and ``reconstruction`` (M, *frame); ``prediction.npz`` has ``original`` and
    ``prediction`` (M, *frame), steps after the start of one episode; ``latents.npz`` has
    ``latents`` (n, d), and where the simulator was at each, ``truth`` (n, k) with its ``names``.
    """
    episodes = judged.episodes[:SHOWN]
    exhibits: dict[str, Arrays] = {} if shown is None else {"animation": {"frames": shown}}
    seen = of.reconstruct(episodes)
    if seen is not None:
        count, times = episodes.frames.shape[:2]
        rows = np.unravel_index(_spread(count * times, RECONSTRUCTED), (count, times))
        exhibits["reconstruction"] = {
            "original": episodes.frames[rows],
            "reconstruction": seen[rows],
        }
    if isinstance(of, Foreseeing) and (ahead := of.foresee(episodes[:1])) is not None:
        some = _spread(ahead.shape[1], RECONSTRUCTED)
        exhibits["prediction"] = {
            "original": episodes.frames[0, 1:][some],
            "prediction": ahead[0][some],
        }
    if judged.truth_names and (latents := of.encode(judged.episodes)) is not None:
        exhibits["latents"] = _points(judged, latents)
    for name, arrays in exhibits.items():
        path = store.folder(cell) / f"{name}.npz"
        beside = path.with_name(f".{name}.{os.getpid()}.npz")
        np.savez_compressed(beside, allow_pickle=False, **arrays)
        beside.replace(path)  # whole or not at all
        store.add_artifact(cell, attempt, name, path, iteration)


def _points(judged: Evaluation, latents: NDArray[Any]) -> Arrays:
    """Some latents of live frames, and the truth behind them."""
    live = judged.episodes.live_frames
    some = _spread(int(live.sum()), POINTS)
    return {
        "latents": latents[live][some].astype(np.float32),
        "truth": judged.truth[live][some].astype(np.float32),
        "names": np.array(judged.truth_names),
    }


def _spread(count: int, most: int) -> NDArray[np.intp]:
    """Indices of at most so many of ``count``, evenly from the first to the last."""
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.intp))
