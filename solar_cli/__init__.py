"""Solar: model-based reinforcement learning from images, run and compared from the command line.

From Python, ``solar_cli.load(db)`` gives every stored metric as a pandas data frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from solar_cli.reporting.frames import load

__all__ = ["load"]


def __getattr__(name: str) -> Any:
    """Import pandas when ``load`` is asked for, not before: the command line starts without it."""
    if name == "load":
        from solar_cli.reporting.frames import load

        return load
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
