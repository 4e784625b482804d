"""Tasks that MuJoCo draws are skipped where it cannot: that is the machine's fault, not theirs."""

from functools import cache

import pytest

from solar_cli.envs.offscreen import load_mujoco, make_renderer
from solar_cli.errors import UsageError

DRAWN_BY_MUJOCO = {"reacher"}


@cache
def lacking():
    """What keeps MuJoCo from drawing here, or nothing."""
    try:
        make_renderer(load_mujoco().MjModel.from_xml_string("<mujoco/>"), 8, 8)
    except UsageError as error:
        return str(error)
    return ""


def skip_if_it_cannot_be_drawn(settings):
    if settings.simulator in DRAWN_BY_MUJOCO and lacking():
        pytest.skip(lacking())
