"""2-D navigation from images: move a point to a goal (section 6.1; a fixed goal, E.1).

The world is a square room, y up. A row is (x, y, goal x, goal y) in world units. A frame has two
channels, the agent and the goal, each a Gaussian blob.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solar_cli.envs.rasteriser import draw_blobs, enlarge
from solar_cli.envs.task import Floats, Frames, RowTask, check_parameters
from solar_cli.errors import UsageError
from solar_cli.settings import TaskSettings

WALL = 2.8
"""the walls stand at +-2.8 and reflect, as in the authors' release"""
START = 1.0
"""agents, and goals that move, start uniformly within +-1 in each coordinate"""
VIEW = 3.2
"""an image shows +-3.2: at 32 pixels a world unit is 5 pixels, as in the authors' release"""
BLOB = 0.2
"""a blob's standard deviation in world units: 1 pixel at 32 (ours)"""
AGENT_INK, GOAL_INK = (0.85, 0.8, 0.75), (0.9, 0.55, 0.1)
"""red, green and blue that a blob takes away from the paper of a picture: dark, and blue"""
OUTSIDE = 0.85
"""grey of a picture behind the walls"""


class Navigation:
    """The simulator. ``goal`` is one place for all episodes, or None for a goal that moves."""

    truth_names: tuple[str, ...] = ("x", "y", "goal_x", "goal_y")

    def __init__(self, goal: Sequence[float] | None, action_cost: float, size: int) -> None:
        self.goal = goal
        self.action_cost = action_cost
        self.size = size
        self._pixels_per_unit = size / (2.0 * VIEW)

    def initial(self, stream: np.random.Generator) -> Floats:
        """Start and goal ~ U(-1, 1)^2, the start first: both kinds of task share their starts."""
        start = stream.uniform(-START, START, 2)
        goal = stream.uniform(-START, START, 2) if self.goal is None else self.goal
        return np.concatenate([start, goal])

    def dynamics(self, rows: Floats, actions: Floats) -> Floats:
        """p + a, reflected by the walls; `build` refuses steps so long that they reflect twice."""
        moved = rows.copy()
        aimed = rows[:, :2] + actions
        # Equals `aimed` inside the room, to the last bit, and its mirror image outside.
        moved[:, :2] = 2.0 * np.minimum(np.maximum(aimed, -WALL), WALL) - aimed
        return moved

    def cost(self, rows: Floats, actions: Floats) -> Floats:
        """|p - g|^2 + alpha |a|^2."""
        return _squared_distance(rows) + self.action_cost * _squared_norm(actions)

    def scenes(self, rows: Floats) -> Frames:
        """The goal, in channel 1."""
        frames = np.zeros((len(rows), 2, self.size, self.size), np.uint8)
        self._draw_points(frames[:, 1], rows[:, 2:])
        return frames

    def draw(self, rows: Floats, scenes: Frames) -> Frames:
        """The agent, in channel 0, with the goal."""
        frames = scenes.copy()
        self._draw_points(frames[:, 0], rows[:, :2])
        return frames

    def measures(self, rows: Floats) -> dict[str, Floats]:
        """``distance``: |p - g| in world units."""
        return {"distance": np.sqrt(_squared_distance(rows))}

    def truth(self, rows: Floats) -> Floats:
        """The rows themselves."""
        return rows.copy()

    def _draw_points(self, images: NDArray[np.uint8], points: Floats) -> None:
        """Blobs at world points (N, 2); the world's centre is the image's, between four pixels."""
        middle = (self.size - 1) / 2.0
        upside_down = points[:, ::-1] * (-self._pixels_per_unit, self._pixels_per_unit)
        draw_blobs(images, middle + upside_down, BLOB * self._pixels_per_unit)


def _squared_norm(vectors: Floats) -> Floats:
    """|v|^2 of (N, 2); written out, as the order of a sum must not depend on the batch."""
    x, y = vectors[:, 0], vectors[:, 1]
    return np.asarray(x * x + y * y)


def _squared_distance(rows: Floats) -> Floats:
    return _squared_norm(rows[:, :2] - rows[:, 2:])


def build(settings: TaskSettings) -> RowTask:
    """The task of a card with ``simulator = "navigation"``.

    Its one parameter is ``goal``, ``"moving"`` (the default) or a place ``[x, y]`` in the room.
    Raises `UsageError` naming the key that does not fit.
    """
    check_parameters(settings, ["goal"])
    seen = settings.observation
    if (seen.kind, seen.channels) != ("image", 2) or seen.height != seen.width:
        raise UsageError(
            "task.observation: simulator 'navigation' draws square images of 2 channels: set "
            "kind = 'image', channels = 2 and height = width"
        )
    if settings.action.size != 2 or settings.action.bound > 2.0 * WALL:
        raise UsageError(
            "task.action: simulator 'navigation' moves in a plane, in steps no longer than its "
            f"room: set size = 2 and bound <= {2.0 * WALL}"
        )
    simulator = Navigation(
        _goal(settings.parameters.get("goal", "moving")), settings.action_cost, seen.height
    )
    return RowTask(simulator, settings)


def _goal(value: Any) -> tuple[float, float] | None:
    if value == "moving":
        return None
    if isinstance(value, (list, tuple)) and len(value) == 2:
        x, y = value
        if all(type(v) in (int, float) and abs(v) <= WALL for v in (x, y)):
            return float(x), float(y)
    raise UsageError(
        f"task.parameters.goal: expected 'moving' or [x, y] within +-{WALL}, not {value!r}"
    )


def picture(frames: Frames, factor: int) -> Floats:
    """Frames (..., 2, H, W) for people, (..., H factor, W factor, 3): dark agent, blue goal.

    The floor is white, what lies behind the walls is grey.
    """
    ink = np.clip(enlarge(frames / 255.0, factor), 0.0, 1.0)[..., None]
    pixels = ink.shape[-2]
    places = np.abs((np.arange(pixels) + 0.5) / pixels - 0.5) * 2.0 * VIEW
    outside = np.maximum(places[:, None], places) > WALL
    paper = np.where(outside, OUTSIDE, 1.0)[..., None]
    agent, goal = ink[..., 0, :, :, :], ink[..., 1, :, :, :]
    return np.asarray(paper * (1.0 - agent * AGENT_INK) * (1.0 - goal * GOAL_INK))
