"""Judging a policy: fresh noise-free episodes that no learner sees (rules of evidence 1 and 2)."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solar_cli.envs import build_task, drawable
from solar_cli.episodes import Evaluation, Policy, evaluate, roll_out
from solar_cli.errors import SolarError
from solar_cli.experiment.watched import WatchedTask
from solar_cli.settings import Cell
from solar_cli.store.records import Metric
from solar_cli.streams import Streams

log = logging.getLogger(__name__)

DRAWN_ROWS = 160
"""of a picture of a task that is learned from its state"""


class Judge:
    """Evaluates the policies of one cell, with a simulator and random streams of its own.

    It calls ``progress`` with the share done, which may raise to end an evaluation.
    """

    def __init__(self, cell: Cell, progress: Callable[[float], None] = lambda _: None) -> None:
        self._configuration = cell.configuration
        self._streams = Streams(cell.seed).under("evaluation")
        self._task = WatchedTask(build_task(cell.configuration.task), progress)

    def evaluate(self, policy: Policy, iteration: int) -> Evaluation:
        """The policy after ``iteration``; 0 is the initial one. The same call, the same numbers."""
        episodes = self._configuration.evaluation.episodes
        self._task.expect(episodes)
        return evaluate(
            self._task,
            self._configuration.task,
            policy,
            episodes,
            self._streams.under(iteration),
        )

    def pictures(
        self, evaluation: Evaluation, iteration: int, episodes: int
    ) -> NDArray[np.uint8] | None:
        """Images (K, T+1, C, H, W) of its first ``episodes``; None where nothing can be seen.

        Where a state is seen, they are played again.
        """
        settings, first = self._configuration.task, evaluation.episodes[:episodes]
        if settings.observation.kind == "image":
            return first.frames
        try:
            shown = drawable(settings, DRAWN_ROWS)
            task = build_task(shown)
            streams = self._streams.under(iteration)
            resets = [streams.generator("reset", i) for i in range(len(first))]
            return roll_out(task, shown, Recorded(first.actions), resets, None).episodes.frames
        except SolarError as error:  # a picture that is missing must not stop a learner
            log.warning("no animation of what was learned: %s", error)
            return None


class Recorded:
    """A policy that does what was done: ``actions`` (N, T, a)."""

    def __init__(self, actions: NDArray[np.float64]) -> None:
        self.actions = actions

    def start(self, episodes: int, stream: np.random.Generator | None) -> None:
        """Nothing is carried through an episode."""

    def act(
        self, observations: NDArray[Any], t: int, state: Any
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], Any]:
        """As `Policy.act`."""
        return self.actions[:, t], self.actions[:, t], state


def measured(evaluation: Evaluation) -> list[Metric]:
    """Every measure's mean, with one value an episode."""
    return [
        Metric(name, float(values.mean()), "noise_free", values)
        for name, values in evaluation.summary().items()
    ]
