"""The scene in MuJoCo."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solar_cli.envs.offscreen import load_mujoco, make_renderer
from solar_cli.envs.sawyer import facts, mjcf
from solar_cli.envs.sawyer.control import PERIOD, Floats, Pose

SUBSTEPS = round(PERIOD / mjcf.STEP)


class _Scene(NamedTuple):
    model: Any
    renderer: Any


@cache
def _scene(height: int, width: int) -> _Scene:
    """Made once in a process: what never changes is the same for all episodes."""
    model = load_mujoco().MjModel.from_xml_string(mjcf.scene())
    return _Scene(model, make_renderer(model, height, width))


class MujocoWorld:
    """A `World`. Raises `UsageError` where MuJoCo is missing or cannot draw."""

    def __init__(self, height: int, width: int) -> None:
        self._mujoco = load_mujoco()
        self._model, self._renderer = _scene(height, width)
        self._data = self._mujoco.MjData(self._model)
        self._held = self._data.body(facts.HELD)
        self._lower = self._data.body(mjcf.LOWER)
        self._free = self._data.joint(mjcf.LOWER)
        self._angles = self._data.qpos[: self._model.nu]

    def reset(self, joints: Floats, lower: Floats) -> None:
        """As `World.reset`."""
        self._mujoco.mj_resetData(self._model, self._data)
        self._angles[:] = self._data.ctrl[:] = joints
        x, y, yaw = lower
        self._free.qpos = (x, y, facts.HEIGHT / 2, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
        self._mujoco.mj_forward(self._model, self._data)

    def joints(self) -> Floats:
        """As `World.joints`."""
        return np.array(self._angles)

    def advance(self, targets: Floats) -> None:
        """As `World.advance`."""
        self._data.ctrl[:] = targets
        self._mujoco.mj_step(self._model, self._data, SUBSTEPS)
        # A step leaves the poses of the state before it.
        self._mujoco.mj_kinematics(self._model, self._data)

    def held(self) -> Pose:
        """As `World.held`."""
        return _pose(self._held)

    def lower(self) -> Pose:
        """As `World.lower`."""
        return _pose(self._lower)

    def image(self) -> NDArray[Any]:
        """As `World.image`."""
        self._renderer.update_scene(self._data, mjcf.CAMERA)
        return np.asarray(self._renderer.render())


def _pose(body: Any) -> Pose:
    return Pose(body.xpos.copy(), body.xmat.reshape(3, 3).copy())
