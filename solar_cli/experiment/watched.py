"""A task whose episodes are watched: how far they are is said at every step."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from solar_cli.envs.task import Floats, Frames, Task


class WatchedTask:
    """A `Task` that calls ``progress`` with the share done of those episodes that it was to expect.

    At each reset and step. ``progress`` may raise, which abandons the episodes under way.
    """

    def __init__(self, task: Task, progress: Callable[[float], None]) -> None:
        self.horizon = task.horizon
        self.action_size = task.action_size
        self.action_bound = task.action_bound
        self.truth_names = task.truth_names
        self.at_once = task.at_once
        self._task = task
        self._progress = progress
        self._expected = self._done = self._running = self._steps = 0

    def expect(self, episodes: int) -> None:
        """Count anew: so many episodes follow, in groups that run side by side."""
        self._expected = episodes
        self._done = self._running = 0

    def reset(self, streams: Sequence[np.random.Generator]) -> Frames:
        """As `Task.reset`."""
        self._done += self._running
        self._running, self._steps = len(streams), 0
        self._tell()
        return self._task.reset(streams)

    def step(self, actions: Floats) -> tuple[Frames, Floats]:
        """As `Task.step`."""
        stepped = self._task.step(actions)
        self._steps += 1
        self._tell()
        return stepped

    def _tell(self) -> None:
        episodes = self._done + self._running * self._steps / self.horizon
        self._progress(episodes / self._expected)

    def ended(self) -> NDArray[np.bool_]:
        """As `Task.ended`."""
        return self._task.ended()

    def measures(self) -> dict[str, Floats]:
        """As `Task.measures`."""
        return self._task.measures()

    def truth(self) -> Floats:
        """As `Task.truth`."""
        return self._task.truth()
