"""Tasks that MuJoCo draws are skipped where it cannot: that is the machine's fault, not theirs."""

from functools import cache

import gymnasium
import pytest

from solar_cli.envs.offscreen import load_mujoco, make_renderer
from solar_cli.errors import UsageError


@cache
def lacking():
    """What keeps MuJoCo from drawing here, or nothing."""
    try:
        make_renderer(load_mujoco().MjModel.from_xml_string("<mujoco/>"), 8, 8)
    except UsageError as error:
        return str(error)
    return ""


def mujoco_draws(settings):
    """Whether a picture of this task is MuJoCo's, for a learner or for people."""
    if settings.simulator == "gymnasium":
        return "mujoco" in str(gymnasium.spec(settings.parameters["id"]).entry_point)
    return settings.simulator == "reacher" or settings.parameters.get("backend") == "mujoco"


def skip_if_it_cannot_be_drawn(settings):
    """Where a learner sees pictures."""
    if settings.observation.kind == "image" and mujoco_draws(settings) and lacking():
        pytest.skip(lacking())
