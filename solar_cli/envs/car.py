"""A nonholonomic car that has to reach a target, seen as images or as numbers (6.1, E.2).

The world is a square, y up. A row is (x, y, theta, v, phi): centre in world units, heading in
radians from +x, speed in world units a second, steering angle in radians. The car starts in the
bottom right, the target is in the top left.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from solar_cli.envs.rasteriser import Box, Disc, draw_figure, enlarge
from solar_cli.envs.task import Floats, Frames, RowTask, StateCost, check_parameters
from solar_cli.errors import UsageError
from solar_cli.settings import Observation, TaskSettings

STEP = 0.1
"""seconds of a step, as in the authors' release"""
WHEELBASE = 1.0
"""as in the authors' release"""
WALL = 2.3
"""the centre stays within +-2.3 in each coordinate, as in the authors' release"""
SPEED = 1.0
"""largest speed, as in the authors' release"""
STEERING = math.pi / 4.0
"""largest steering angle, as in the authors' release"""
START = (1.5, -1.5, math.pi / 2.0)
"""mean of the first (x, y, theta); the car stands, its wheels straight"""
START_STD = 0.1
"""standard deviation of each of the three"""
TARGET = (-2.0, 2.0)
"""as in the authors' release"""

VIEW = 8.0 / 3.0
"""an image shows +-2.667: at 64 pixels a world unit is 12 pixels, as in the authors' release"""
CAR = (
    # Two axles as wide as their wheels, of which the body leaves the ends; then the windscreen.
    Box((-0.36, 0.0), (0.16, 0.38), 128.0),
    Box((0.36, 0.0), (0.16, 0.38), 128.0),
    Box((0.0, 0.0), (0.6, 0.3), 255.0),
    Box((0.2, 0.0), (0.12, 0.24), 0.0),
)
"""in world units, on black; the body is the release's, 1.2 by 0.6, all else ours"""
MARK = (Disc((0.0, 0.0), 0.107, 255.0),)
"""of the target, in world units; its radius is the release's"""
AGENT_INK, TARGET_INK = (0.85, 0.8, 0.75), (0.9, 0.55, 0.1)
"""red, green and blue that a picture's car and target take away from its paper: dark, and blue"""
PICTURE = 64
"""side of a picture of a state, before it is enlarged"""


class Car:
    """The simulator, but for what is seen."""

    truth_names: tuple[str, ...] = ("x", "y", "cos", "sin")

    def __init__(self, action_cost: float) -> None:
        self.action_cost = action_cost

    def initial(self, stream: np.random.Generator) -> Floats:
        """Bottom right, facing up, each of x, y and theta with normal noise."""
        place = np.array(START) + START_STD * stream.standard_normal(3)
        return np.concatenate([place, np.zeros(2)])

    def dynamics(self, rows: Floats, actions: Floats) -> Floats:
        """Semi-implicit Euler: v and phi first, then x, y and theta with the new v and phi.

        With explicit Euler an action first shows in the frame after the next one, so that windows
        of frames would not be a state. The paper does not name its integrator.
        """
        x, y, theta, v, phi = rows.T.copy()
        v = _within(v + STEP * actions[:, 0], SPEED)
        phi = _within(phi + STEP * actions[:, 1], STEERING)
        x = _within(x + STEP * v * np.cos(theta), WALL)
        y = _within(y + STEP * v * np.sin(theta), WALL)
        theta = theta + STEP * v * np.tan(phi) / WHEELBASE
        return np.stack([x, y, theta, v, phi], axis=1)

    def cost(self, rows: Floats, actions: Floats) -> Floats:
        """|p - g|^2 + alpha |a|^2."""
        a = actions
        action = a[:, 0] * a[:, 0] + a[:, 1] * a[:, 1]
        return _squared_distance(rows) + self.action_cost * action

    def measures(self, rows: Floats) -> dict[str, Floats]:
        """``distance``: from the car's centre to the target, in world units."""
        return {"distance": np.sqrt(_squared_distance(rows))}

    def truth(self, rows: Floats) -> Floats:
        """Centre, and cosine and sine of the heading; the target never moves."""
        x, y, theta = rows[:, :3].T.copy()
        return np.stack([x, y, np.cos(theta), np.sin(theta)], axis=1)


class CarFromImages(Car):
    """Seen as grey images (1, size, size): a bright car with a dark windscreen, a bright target."""

    def __init__(self, action_cost: float, size: int) -> None:
        super().__init__(action_cost)
        self.size = size
        unit = size / (2.0 * VIEW)
        self._pixels_per_unit = unit
        self._car = [part.scaled(unit) for part in CAR]
        self._mark = [part.scaled(unit) for part in MARK]

    def scenes(self, rows: Floats) -> Frames:
        """The target."""
        frames = np.zeros((len(rows), 1, self.size, self.size), np.uint8)
        targets = self._places(np.tile(TARGET, (len(rows), 1)))
        draw_figure(frames[:, 0], targets, np.zeros(len(rows)), self._mark)
        return frames

    def draw(self, rows: Floats, scenes: Frames) -> Frames:
        """The car, over the target."""
        frames = scenes.copy()
        draw_figure(frames[:, 0], self._places(rows[:, :2]), rows[:, 2].copy(), self._car)
        return frames

    def _places(self, points: Floats) -> Floats:
        """(row, column) of world points (N, 2); the world's centre is between four pixels."""
        middle = (self.size - 1) / 2.0
        return middle + points[:, ::-1] * (-self._pixels_per_unit, self._pixels_per_unit)


class CarFromStates(Car):
    """Seen as numbers: x, y, cos theta, sin theta, v, cos phi, sin phi, target x, target y."""

    def scenes(self, rows: Floats) -> Frames:
        """The target."""
        frames = np.zeros((len(rows), 9), np.float32)
        frames[:, 7:] = TARGET
        return frames

    def draw(self, rows: Floats, scenes: Frames) -> Frames:
        """The car, with the target."""
        x, y, theta, v, phi = rows.T.copy()
        frames = scenes.copy()
        seen = (x, y, np.cos(theta), np.sin(theta), v, np.cos(phi), np.sin(phi))
        frames[:, :7] = np.stack(seen, axis=1)
        return frames


def _within(values: Floats, bound: float) -> Floats:
    return np.minimum(np.maximum(values, -bound), bound)


def _squared_distance(rows: Floats) -> Floats:
    x, y = rows[:, 0] - TARGET[0], rows[:, 1] - TARGET[1]
    return np.asarray(x * x + y * y)


def build(settings: TaskSettings) -> RowTask:
    """The task of a card with ``simulator = "car"``; the kind of its observation decides.

    Raises `UsageError` naming the key that does not fit.
    """
    check_parameters(settings, [])
    seen = settings.observation
    if settings.action.size != 2:
        raise UsageError(
            "task.action: simulator 'car' takes acceleration and steering velocity: set size = 2"
        )
    if seen.kind == "state":
        if seen.width != 9:
            raise UsageError(
                "task.observation: simulator 'car' shows a state of 9 numbers: set width = 9"
            )
        return RowTask(CarFromStates(settings.action_cost), settings)
    if seen.channels != 1 or seen.height != seen.width:
        raise UsageError(
            "task.observation: simulator 'car' draws square grey images: set channels = 1 and "
            "height = width"
        )
    return RowTask(CarFromImages(settings.action_cost, seen.height), settings)


def state_cost(settings: TaskSettings) -> StateCost:
    """As `StateCost`, of states (..., 9)."""

    def cost(states: Any, actions: Any) -> Any:
        apart = states[..., 0:2] - states[..., 7:9]
        return (apart * apart).sum(-1) + settings.action_cost * (actions * actions).sum(-1)

    return cost


def drawable(settings: TaskSettings, rows: int) -> TaskSettings:
    """The same task seen as square images with that many rows."""
    seen = Observation(kind="image", height=rows, width=rows)
    return settings.model_copy(update={"observation": seen})


def picture(frames: Frames, factor: int) -> Floats:
    """Frames for people, (..., rows, columns, 3) in [0, 1]: a dark car, a blue target.

    Images (..., 1, H, W) are enlarged by ``factor``; states (..., 9) are drawn ``factor`` times as
    large as on 64x64 pixels.
    """
    if frames.dtype == np.uint8:
        ink = np.clip(enlarge(frames[..., 0, :, :] / 255.0, factor), 0.0, 1.0)
    else:
        ink = _drawn(frames, PICTURE * factor)
    size = ink.shape[-1]
    target = CarFromImages(0.0, size).scenes(np.zeros((1, 5)))[0, 0] / 255.0
    agent_ink, target_ink = np.array(AGENT_INK), np.array(TARGET_INK)
    colour = agent_ink + target[..., None] * (target_ink - agent_ink)
    return np.asarray(1.0 - ink[..., None] * colour)


def _drawn(states: Frames, size: int) -> Floats:
    """States (..., 9) as images (..., size, size) in [0, 1]."""
    flat = states.reshape(-1, 9).astype(np.float64)
    rows = np.zeros((len(flat), 5))
    rows[:, :2], rows[:, 2] = flat[:, :2], np.arctan2(flat[:, 3], flat[:, 2])
    car = CarFromImages(0.0, size)
    images = car.draw(rows, car.scenes(rows)) / 255.0
    return np.asarray(images.reshape(*states.shape[:-1], size, size))
