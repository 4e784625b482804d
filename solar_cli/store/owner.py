"""Who computes a cell, and whether that process still lives.

A process id alone is reused, so an owner is the pid *and* the start time of the process, within one
boot of one machine. A process that cannot be looked up from here (another machine, another
container, no ``/proc``) is judged by its lease instead: see `Store.claim`.
"""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")


@dataclass(frozen=True)
class Owner:
    """A process that may write the results of a cell."""

    host: str
    """name of the machine, for people"""
    pid: int
    process_start: float
    """when the process started, in seconds since boot"""
    boot: str
    """this boot of this machine (and its process-id namespace); empty where it is not known"""

    @classmethod
    def current(cls) -> Owner:
        """The owner that this process is."""
        return cls.of(os.getpid())

    @classmethod
    def of(cls, pid: int) -> Owner:
        """The owner that the process ``pid`` of this machine is, such as a worker just started."""
        start = process_start(pid)
        return cls(socket.gethostname(), pid, start or 0.0, boot() if start is not None else "")


def is_alive(owner: Owner) -> bool | None:
    """Whether the process still runs; ``None`` where that cannot be seen from here."""
    if not owner.boot or owner.boot != boot():
        return None
    return process_start(owner.pid) == owner.process_start


def boot() -> str:
    """What two processes share exactly when they see each other's process ids; else empty.

    The host's name would not do: many machines are called ``localhost``, and containers share the
    boot but not the process ids.
    """
    try:
        identity = (PROC / "sys/kernel/random/boot_id").read_text().strip()
        return f"{identity}/{os.readlink(PROC / 'self/ns/pid')}"
    except OSError:
        return ""


def process_start(pid: int) -> float | None:
    """Start of a process in seconds since boot; ``None`` when there is no such process.

    A zombie, killed but not yet waited for by its parent, no longer computes: it counts as gone.
    """
    try:
        text = (PROC / str(pid) / "stat").read_text()
    except OSError:
        return None
    # The second field, the command in parentheses, may itself hold spaces and parentheses.
    state, *fields = text.rpartition(")")[2].split()
    if state in "ZX":
        return None
    ticks = int(fields[18])  # field 22 of the line, ``starttime``
    return ticks / os.sysconf("SC_CLK_TCK")
