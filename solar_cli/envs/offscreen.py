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
NO_GRAPHICS = "disabled"
"""as ``MUJOCO_GL``"""
MOST_GEOMS = 100
"""things that a scene may show"""


def load_mujoco(*, to_draw: bool = True) -> Any:
    """The package ``mujoco``, with its graphics library where there is one.

    Raises `UsageError` where the package is missing, or the library and it is loaded ``to_draw``.
    """
    if "mujoco" not in sys.modules:
        for name, value in DEFAULTS.items():
            os.environ.setdefault(name, value)
    try:
        import mujoco
    except Exception as error:  # a graphics library that is not there shows in many ways
        if isinstance(error, ModuleNotFoundError) and error.name == "mujoco":
            raise UsageError("the package mujoco is missing here: pip install mujoco") from error
        if to_draw or os.environ.get("MUJOCO_GL") == NO_GRAPHICS:
            raise cannot_draw(error) from error
        return _without_graphics()
    if to_draw and not hasattr(mujoco, "GLContext"):
        raise cannot_draw(ImportError("MuJoCo was loaded without a graphics library"))
    return mujoco


def _without_graphics() -> Any:
    """The package ``mujoco``, which is told for this once to look for no graphics library."""
    before = os.environ["MUJOCO_GL"]
    os.environ["MUJOCO_GL"] = NO_GRAPHICS
    try:
        return load_mujoco(to_draw=False)
    finally:
        os.environ["MUJOCO_GL"] = before


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
