"""MuJoCo, which draws without a screen, or one line that says what this machine lacks for it."""

from __future__ import annotations

import atexit
import os
import sys
import warnings
from typing import Any

from solar_cli.errors import UsageError

DEFAULTS = {
    "MUJOCO_GL": "egl",
    # Software rendering within the calling thread: small pictures gain nothing from others.
    "LP_NUM_THREADS": "0",
}
"""environment, set unless the user has: libraries read it when they are loaded"""
MOST_GEOMS = 100
"""things that a scene may show"""


def load_mujoco() -> Any:
    """The package ``mujoco``. Raises `UsageError` where it or its graphics library is missing."""
    if "mujoco" not in sys.modules:
        for name, value in DEFAULTS.items():
            os.environ.setdefault(name, value)
    try:
        import mujoco
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise cannot_draw(error) from error
        raise UsageError("the package mujoco is missing here: pip install mujoco") from error
    except Exception as error:  # a graphics library that is not there shows in many ways
        raise cannot_draw(error) from error
    return mujoco


def make_renderer(model: Any, height: int, width: int) -> Any:
    """A `mujoco.Renderer` for pictures (height, width, 3) of ``model``, which it adapts to them.

    It is freed when Python ends, in time. Raises `UsageError` where nothing can be drawn.
    """
    mujoco = load_mujoco()
    model.vis.global_.offheight, model.vis.global_.offwidth = height, width
    try:
        with warnings.catch_warnings():
            # GLFW only warns where there is no screen, and MuJoCo goes on until it crashes.
            warnings.filterwarnings("error", module="glfw")
            renderer = mujoco.Renderer(model, height, width, MOST_GEOMS)
    except Exception as error:
        raise cannot_draw(error) from error
    # Handlers run last in, first out: before the one by which MuJoCo has just arranged to end EGL.
    atexit.register(renderer.close)
    return renderer


def cannot_draw(error: Exception) -> UsageError:
    """What is wrong with the graphics library, and what to install."""
    cause = " ".join(f"{type(error).__name__}: {error}".split())
    return UsageError(
        f"MuJoCo cannot draw here, MUJOCO_GL is {os.environ.get('MUJOCO_GL') or 'not set'} "
        f"({cause}): install libegl1 and libgl1-mesa-dri for MUJOCO_GL=egl, or libosmesa6 for "
        "MUJOCO_GL=osmesa"
    )
