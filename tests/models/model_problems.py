"""Small problems for models: a task of vectors, latents of made-up episodes."""

from __future__ import annotations

import numpy as np
import torch

from solar_cli.episodes import Episodes
from solar_cli.models.priors import Segments
from solar_cli.settings import TaskSettings


def vector_task(
    horizon: int = 8, width: int = 3, window: int = 1, actions: int = 2
) -> TaskSettings:
    """A task whose frames are vectors."""
    return TaskSettings.model_validate(
        {
            "simulator": "none",
            "horizon": horizon,
            "observation": {"kind": "state", "width": width, "window": window},
            "action": {"size": actions, "bound": 1.0},
            "exploration": {"std": 0.3},
        }
    )


def vector_episodes(task: TaskSettings, count: int, seed: int = 0) -> Episodes:
    """Frames that drift as actions push them; costs are a quadratic of the frames."""
    rng = np.random.default_rng(seed)
    width = task.observation.width
    push = np.random.default_rng(99).normal(size=(task.action.size, width))
    actions = rng.normal(0, 0.3, (count, task.horizon, task.action.size))
    frames = np.empty((count, task.horizon + 1, width))
    frames[:, 0] = rng.normal(size=(count, width))
    for t in range(task.horizon):
        frames[:, t + 1] = 0.95 * frames[:, t] + actions[:, t] @ push
    costs = np.square(frames[:, :-1]).sum(axis=-1) + np.square(actions).sum(axis=-1)
    window = task.observation.window
    return Episodes(frames.astype(np.float32), actions, 0.5 * actions, costs, window)


def made_up_segments(
    seed: int, starts: list[int], length: int, d: int = 2, actions: int = 1
) -> Segments:
    """Means, variances and actions of segments that start at these time steps."""
    rng = np.random.default_rng(seed)
    count = len(starts)
    return Segments(
        torch.as_tensor(rng.normal(size=(count, length, d))),
        torch.as_tensor(rng.uniform(0.05, 0.6, size=(count, length, d))),
        torch.as_tensor(rng.normal(size=(count, length - 1, actions))),
        torch.tensor(starts),
    )
