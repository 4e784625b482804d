"""The errors a user may see: each message says what is wrong, where, and what to do.

``SolarError``            the command cannot go on (exit code 1)
├── ``LostFiles``         what was stored in files is not there any more (exit code 1)
└── ``UsageError``        the user's input is wrong (exit code 2)
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SolarError(Exception):
    """An expected failure, shown to the user as one line without a traceback."""

    exit_code = 1


class LostFiles(SolarError):
    """Files of a cell are missing or damaged: once they are restored, it can go on."""


class UsageError(SolarError):
    """Input that the user has to change: an option, a card, a database address."""

    exit_code = 2


def nearest(name: str, known: Iterable[str]) -> str:
    """A hint for a misspelt ``name``: the nearest known one, or all of them."""
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(names) or 'none'}"
