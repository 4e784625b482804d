"""What a worker tells its supervisor: whole snapshots, one JSON object a line."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

LONGEST = 300
"""characters of an activity, of up to 12 bytes each: a pipe writes lines of 4096 bytes whole"""


@dataclass(frozen=True)
class Message:
    """Where a worker stands."""

    iteration: int
    """that it works at; 0 is the evaluation of the initial policy"""
    episodes: int
    """committed with the last finished iteration"""
    headline: float | None
    """the card's headline measure at the last evaluation"""
    activity: str
    """what it is doing"""
    fraction: float
    """share of that which is done"""

    def line(self) -> bytes:
        """The message as it goes over the pipe."""
        values = asdict(self) | {"activity": self.activity[:LONGEST]}
        return json.dumps(values).encode() + b"\n"

    @classmethod
    def parse(cls, line: bytes) -> Message:
        """The message of one line. Raises `ValueError` for anything else."""
        values = json.loads(line)
        try:
            return cls(**values)
        except TypeError as error:
            raise ValueError(f"not a message: {line!r}") from error
