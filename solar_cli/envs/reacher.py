"""Reacher from images: bring the tip of a planar arm of two links to a target (section 6.1).

MuJoCo moves and draws the arm (``reacher.xml``). A row is (shoulder angle, elbow angle, and their
velocities), in radians and seconds; all rows share one simulation, which each sets anew. A frame is
the arm and the target from above, in RGB; places are in metres, x to the right and y up.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solar_cli.envs.offscreen import load_mujoco, make_renderer
from solar_cli.envs.rasteriser import enlarge
from solar_cli.envs.task import Floats, Frames, RowTask, check_parameters
from solar_cli.errors import UsageError
from solar_cli.settings import TaskSettings

MODEL = Path(__file__).with_suffix(".xml")
SUBSTEPS = 2
"""steps of the simulation that an action holds for, as in Gymnasium's Reacher"""
STEP_SECONDS = 0.02
"""simulated time of these"""
ANGLE, SPEED = 0.1, 0.005
"""joints start uniformly within +-0.1 rad and +-0.005 rad/s, as in Gymnasium's Reacher"""
TARGET = (-0.1, -0.1)
"""the bottom left of section 6.1, as in the authors' release"""
REACH = 0.21
"""lengths of the links to the middle of the tip, together"""


class World(NamedTuple):
    """One simulation, and what draws it."""

    model: Any
    data: Any
    renderer: Any


@cache
def _world(target: tuple[float, float], size: int) -> World:
    """Made once in a process: graphics contexts are large, and slow to switch between."""
    mujoco = load_mujoco()
    model = mujoco.MjModel.from_xml_path(str(MODEL))
    model.body("target").pos[:2] = target
    return World(model, mujoco.MjData(model), make_renderer(model, size, size))


class Reacher:
    """The simulator."""

    truth_names: tuple[str, ...] = ("elbow_x", "elbow_y", "tip_x", "tip_y")

    def __init__(self, target: tuple[float, float], action_cost: float, size: int) -> None:
        self.target = np.array(target)
        self.action_cost = action_cost
        self.size = size
        self._mujoco = load_mujoco()
        self._model, self._data, self._renderer = _world(target, size)
        self._places = [self._model.body(name).id for name in ("lower", "tip")]

    def initial(self, stream: np.random.Generator) -> Floats:
        """Almost stretched out to the right, almost at rest."""
        return np.concatenate([stream.uniform(-ANGLE, ANGLE, 2), stream.uniform(-SPEED, SPEED, 2)])

    def dynamics(self, rows: Floats, actions: Floats) -> Floats:
        """Both joints under torques of 200 times the actions, for `STEP_SECONDS`."""
        data, moved = self._data, np.empty_like(rows)
        for row, action, after in zip(rows, actions, moved, strict=True):
            data.qpos, data.qvel, data.ctrl = row[:2], row[2:], action
            self._mujoco.mj_step(self._model, data, SUBSTEPS)
            after[:2], after[2:] = data.qpos, data.qvel
        return moved

    def cost(self, rows: Floats, actions: Floats) -> Floats:
        """|tip - target| + alpha |a|^2."""
        first, second = actions[:, 0], actions[:, 1]
        return self._distance(rows) + self.action_cost * (first * first + second * second)

    def scenes(self, rows: Floats) -> Frames:
        """Nothing is drawn ahead: the arm may hide whatever stands still."""
        return np.empty((len(rows), 0), np.uint8)

    def draw(self, rows: Floats, scenes: Frames) -> Frames:
        """Arm and target, (N, 3, size, size)."""
        pixels = np.empty((len(rows), self.size, self.size, 3), np.uint8)
        for row, image in zip(rows, pixels, strict=True):
            self._put(row)
            self._renderer.update_scene(self._data, "above")
            self._renderer.render(out=image)
        return np.ascontiguousarray(pixels.transpose(0, 3, 1, 2))

    def measures(self, rows: Floats) -> dict[str, Floats]:
        """``distance``: |tip - target| in metres."""
        return {"distance": self._distance(rows)}

    def truth(self, rows: Floats) -> Floats:
        """Where elbow and tip are.

        Up to scale that is cosine and sine of both links' directions: what linear maps of images
        can find, unlike angles, which jump, or the elbow's own, which multiplies the two.
        """
        return self._positions(rows)

    def _put(self, row: Floats) -> None:
        """Place all bodies as ``row`` (4,) says."""
        self._data.qpos = row[:2]
        self._mujoco.mj_kinematics(self._model, self._data)
        self._mujoco.mj_camlight(self._model, self._data)

    def _positions(self, rows: Floats) -> Floats:
        """Elbow and tip, x and y each, (N, 4)."""
        positions = np.empty((len(rows), 4))
        for row, position in zip(rows, positions, strict=True):
            self._put(row)
            position[:] = self._data.xpos[self._places, :2].ravel()
        return positions

    def _distance(self, rows: Floats) -> Floats:
        x, y = (self._positions(rows)[:, 2:] - self.target).T
        return np.asarray(np.sqrt(x * x + y * y))


def build(settings: TaskSettings) -> RowTask:
    """The task of a card with ``simulator = "reacher"``.

    Its one parameter is ``target``, a place ``[x, y]`` within reach. Raises `UsageError` naming the
    key that does not fit, or what MuJoCo lacks here.
    """
    check_parameters(settings, ["target"])
    seen = settings.observation
    if (seen.kind, seen.channels) != ("image", 3) or seen.height != seen.width:
        raise UsageError(
            "task.observation: simulator 'reacher' draws square images of 3 channels: set "
            "kind = 'image', channels = 3 and height = width"
        )
    if (settings.action.size, settings.action.bound) != (2, 1.0):
        raise UsageError(
            "task.action: simulator 'reacher' has 2 motors that saturate at 1: set size = 2 and "
            "bound = 1.0"
        )
    if settings.step_seconds != STEP_SECONDS:
        raise UsageError(
            f"task.step_seconds: simulator 'reacher' makes steps of {STEP_SECONDS} s: set that"
        )
    target = _target(settings.parameters.get("target", TARGET))
    return RowTask(Reacher(target, settings.action_cost, seen.height), settings)


def _target(value: Any) -> tuple[float, float]:
    if isinstance(value, (list, tuple)) and len(value) == 2:
        x, y = value
        if all(type(v) in (int, float) for v in (x, y)) and x * x + y * y <= REACH**2:
            return float(x), float(y)
    raise UsageError(
        f"task.parameters.target: expected [x, y] within {REACH} m of the shoulder, not {value!r}"
    )


def picture(frames: Frames, factor: int) -> NDArray[np.float64]:
    """Frames (..., 3, H, W) for people: the same, enlarged, (..., H factor, W factor, 3)."""
    colours = np.clip(enlarge(frames / 255.0, factor), 0.0, 1.0)
    return np.asarray(np.moveaxis(colours, -3, -1))
