"""How a sentence counts things."""

from __future__ import annotations


def plural(noun: str, count: int) -> str:
    """``episode`` for one, ``episodes`` for any other count."""
    return noun if count == 1 else f"{noun}s"


def counted(count: int, noun: str) -> str:
    """``1 episode`` or ``2 episodes``."""
    return f"{count} {plural(noun, count)}"
