"""Simulators, batched over episodes: one interface for every task (`solar_cli.envs.task`).

A simulator is a module with two functions, ``build(settings) -> Restartable`` and
``picture(frames, factor) -> (..., H factor, W factor, 3)`` in [0, 1], and a line in `SIMULATORS`.
One that shows states has a third, ``drawable(settings, rows)``: the same task, seen as images; and
for methods that may know the cost a fourth, ``state_cost(settings)``.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from solar_cli.envs.task import Frames, Restartable, StateCost, Task
from solar_cli.errors import UsageError, nearest
from solar_cli.settings import TaskSettings

__all__ = ["SIMULATORS", "Task", "build_task", "drawable", "picture", "state_cost"]

SIMULATORS = {
    "gymnasium": "solar_cli.envs.gymnasium_task",
    "navigation": "solar_cli.envs.navigation",
    "car": "solar_cli.envs.car",
    "reacher": "solar_cli.envs.reacher",
    "sawyer": "solar_cli.envs.sawyer",
}
"""name on a card -> module, imported when used"""


def build_task(settings: TaskSettings) -> Restartable:
    """The task that ``settings`` describe. Raises `UsageError` for what its simulator lacks."""
    task: Restartable = _simulator(settings).build(settings)
    return task


def picture(settings: TaskSettings, frames: Frames, factor: int = 8) -> NDArray[np.uint8]:
    """Learner frames (..., C, H, W) as pictures for people, RGB (..., H factor, W factor, 3).

    Those of `drawable` may be given with the settings of the task that shows states, too.
    """
    colours: NDArray[np.float64] = _simulator(settings).picture(frames, factor)
    return np.rint(255.0 * colours).astype(np.uint8)


def state_cost(settings: TaskSettings) -> StateCost:
    """The task's own cost of states as they are seen, for methods that may know it.

    Raises `UsageError` where images are seen, or where the simulator cannot say.
    """
    if settings.observation.kind == "image":
        raise UsageError("the task is seen as images, of which no cost is known")
    simulator = _simulator(settings)
    if not hasattr(simulator, "state_cost"):
        raise UsageError(f"simulator {settings.simulator!r} says no cost of its states")
    cost: StateCost = simulator.state_cost(settings)
    return cost


def drawable(settings: TaskSettings, rows: int = 240) -> TaskSettings:
    """The same task, seen as images: as it is, or with that many rows in place of a state.

    Raises `UsageError` where there is nothing to draw.
    """
    if settings.observation.kind == "image":
        return settings
    seen: TaskSettings = _simulator(settings).drawable(settings, rows)
    return seen


def _simulator(settings: TaskSettings) -> ModuleType:
    if settings.simulator not in SIMULATORS:
        raise UsageError(
            f"task.simulator: no simulator is named {settings.simulator!r}: "
            f"{nearest(settings.simulator, SIMULATORS)}"
        )
    return import_module(SIMULATORS[settings.simulator])
