"""A Sawyer arm that stacks Lego bricks, in PyBullet or in MuJoCo: see `stacking`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from solar_cli.envs.rasteriser import enlarge
from solar_cli.envs.sawyer.control import PERIOD, Floats
from solar_cli.envs.sawyer.stacking import Stacking
from solar_cli.envs.sawyer.world import World
from solar_cli.envs.task import Frames, LoopTask, check_parameters
from solar_cli.errors import UsageError, nearest
from solar_cli.settings import TaskSettings

BACKENDS = ("pybullet", "mujoco")
JITTER, MOST_JITTER = 0.002, 0.02
"""m by which the lower brick may be off either way in x and in y: by default, and at most"""


def build(settings: TaskSettings) -> LoopTask:
    """The task of a card with ``simulator = "sawyer"``.

    Its parameters are ``backend``, ``"pybullet"`` (the default) or ``"mujoco"``, and ``jitter``, by
    how many m the lower brick may be off in x and in y. Raises `UsageError` naming the key that
    does not fit, or the engine that is not installed.
    """
    check_parameters(settings, ["backend", "jitter"])
    seen, periods = settings.observation, round(settings.step_seconds / PERIOD)
    if (seen.kind, seen.channels) != ("image", 3):
        raise UsageError(
            "task.observation: simulator 'sawyer' draws colour images: set kind = 'image' and "
            "channels = 3"
        )
    if settings.action.size != 4 or settings.action.bound > 1.0:
        raise UsageError(
            "task.action: simulator 'sawyer' takes velocities along x, y, z and about z, 1 being "
            "the fastest: set size = 4 and bound <= 1.0"
        )
    if periods < 1 or abs(periods * PERIOD - settings.step_seconds) > 1e-9:
        raise UsageError(
            f"task.step_seconds: simulator 'sawyer' is controlled every {PERIOD} s: set a multiple "
            f"of that, not {settings.step_seconds}"
        )
    engine, jitter = _engine(settings), _jitter(settings)

    def simulation() -> Stacking:
        world = engine(seen.height, seen.width)
        return Stacking(world, jitter, periods, settings.action_cost)

    return LoopTask(simulation, settings)


def _jitter(settings: TaskSettings) -> float:
    value = settings.parameters.get("jitter", JITTER)
    if type(value) in (int, float) and 0.0 <= value <= MOST_JITTER:
        return float(value)
    raise UsageError(f"task.parameters.jitter: expected 0 to {MOST_JITTER} m, not {value!r}")


def _engine(settings: TaskSettings) -> Callable[[int, int], World]:
    """What makes a world, given the sides of its images."""
    backend = settings.parameters.get("backend", BACKENDS[0])
    if backend not in BACKENDS:
        raise UsageError(
            f"task.parameters.backend: no engine is named {backend!r}: "
            f"{nearest(str(backend), BACKENDS)}"
        )
    if backend == "mujoco":
        from solar_cli.envs.sawyer.mujoco_world import MujocoWorld

        return MujocoWorld
    try:
        from solar_cli.envs.sawyer.pybullet_world import PybulletWorld
    except ImportError as error:
        raise UsageError(
            "task.parameters.backend: the package pybullet is missing here, and has no wheel for "
            "Python 3.12 and newer: --set 'task.parameters.backend=\"mujoco\"' does without it"
        ) from error
    return PybulletWorld


def picture(frames: Frames, factor: int) -> Floats:
    """Frames (..., 3, H, W) for people, (..., H factor, W factor, 3)."""
    return np.moveaxis(np.clip(enlarge(frames / 255.0, factor), 0.0, 1.0), -3, -1)
