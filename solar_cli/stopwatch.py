"""Where the time of an iteration goes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


class Stopwatch:
    """Wall-clock seconds by activity; what runs inside an activity is not counted to it."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._running: list[str] = []
        self._since = 0.0

    @contextmanager
    def running(self, activity: str) -> Iterator[None]:
        """Time the body; as a decorator, every call of a function."""
        self._charge()
        self._running.append(activity)
        try:
            yield
        finally:
            self._charge()
            self._running.pop()

    def seconds(self) -> dict[str, float]:
        """Of each activity so far, those that are running included."""
        self._charge()
        return dict(self._seconds)

    def go_on_from(self, seconds: Mapping[str, float]) -> None:
        """Forget what was counted, and count from ``seconds``."""
        self._charge()
        self._seconds = dict(seconds)

    def _charge(self) -> None:
        """Count what has passed to the innermost activity."""
        now = time.monotonic()
        if self._running:
            activity = self._running[-1]
            self._seconds[activity] = self._seconds.get(activity, 0.0) + now - self._since
        self._since = now
