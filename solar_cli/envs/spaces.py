"""What a task's observations and actions are to Gymnasium."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from solar_cli.settings import TaskSettings


def observation_space(settings: TaskSettings) -> spaces.Box:
    """Windows stacked along the first axis of a frame, oldest first: (W C, H, W) or (W S,)."""
    seen = settings.observation
    shape = (seen.window * seen.frame_shape[0], *seen.frame_shape[1:])
    if seen.kind == "image":
        return spaces.Box(0, 255, shape, np.uint8)
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def action_space(settings: TaskSettings) -> spaces.Box:
    """Actions in the card's units."""
    bound = settings.action.bound
    return spaces.Box(-bound, bound, (settings.action.size,), np.float32)
