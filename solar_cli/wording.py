"""How a sentence counts things, and what it leaves out."""

from __future__ import annotations

import re

PASSWORD = re.compile(r"(?<=://)([^/?:@]*:)[^@]*(?=@)|([?&]password=)[^&]*")
"""in a database's address"""


def plural(noun: str, count: int) -> str:
    """``episode`` for one, ``episodes`` for any other count."""
    return noun if count == 1 else f"{noun}s"


def counted(count: int, noun: str) -> str:
    """``1 episode`` or ``2 episodes``."""
    return f"{count} {plural(noun, count)}"


def without_password(address: str) -> str:
    """The address, or a word with it, with ``***`` in the place of a password."""
    return PASSWORD.sub(lambda found: f"{found[1] or found[2]}***", address)
