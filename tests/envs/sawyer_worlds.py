"""Both engines' worlds, made once; skipped where an engine is missing or cannot draw."""

from functools import cache

import pytest

from solar_cli.errors import UsageError

SIDE = 84


@cache
def make_world(engine):
    if engine == "pybullet":
        pytest.importorskip("pybullet")
        from solar_cli.envs.sawyer.pybullet_world import PybulletWorld as World
    else:
        from solar_cli.envs.sawyer.mujoco_world import MujocoWorld as World
    try:
        return World(SIDE, SIDE)
    except UsageError as error:
        pytest.skip(str(error))
