"""A task whose episodes are watched: how far they are is said at every step."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from solar_cli.envs.task import Floats, Frames, Task


class WatchedTask:
    """A `Task` that calls ``progress`` with the share of its horizon done, at reset and each step.

    ``progress`` may raise, which abandons the episodes under way: the next ones start with a reset.
    """

    def __init__(self, task: Task, progress: Callable[[float], None]) -> None:
        self.horizon = task.horizon
        self.action_size = task.action_size
        self.action_bound = task.action_bound
        self.truth_names = task.truth_names
        self.at_once = task.at_once
        self._task = task
        self._progress = progress
        self._steps = 0

    def reset(self, streams: Sequence[np.random.Generator]) -> Frames:
        """As `Task.reset`."""
        self._steps = 0
        self._progress(0.0)
        return self._task.reset(streams)

    def step(self, actions: Floats) -> tuple[Frames, Floats]:
        """As `Task.step`."""
        stepped = self._task.step(actions)
        self._steps += 1
        self._progress(self._steps / self.horizon)
        return stepped

    def ended(self) -> NDArray[np.bool_]:
        """As `Task.ended`."""
        return self._task.ended()

    def measures(self) -> dict[str, Floats]:
        """As `Task.measures`."""
        return self._task.measures()

    def truth(self) -> Floats:
        """As `Task.truth`."""
        return self._task.truth()
