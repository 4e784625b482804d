"""What a long computation tells whoever runs it."""

from __future__ import annotations

from collections.abc import Callable

Pulse = Callable[[str, float], None]
"""Called with what is being done and the share done, every few gradient steps.

The caller may save ``state_dict()`` then, or raise to stop: at a pulse the state is consistent.
"""


class Diverged(Exception):
    """A task or its learner has left the realm of finite numbers; the message says where."""
