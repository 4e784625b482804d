"""Judging a policy: fresh noise-free episodes that no learner sees (rules of evidence 1 and 2)."""

from __future__ import annotations

from collections.abc import Callable

from solar_cli.envs import build_task
from solar_cli.episodes import Evaluation, Policy, evaluate
from solar_cli.experiment.watched import WatchedTask
from solar_cli.settings import Cell
from solar_cli.store.records import Metric
from solar_cli.streams import Streams


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


def measured(evaluation: Evaluation) -> list[Metric]:
    """Every measure's mean, with one value an episode."""
    return [
        Metric(name, float(values.mean()), "noise_free", values)
        for name, values in evaluation.summary().items()
    ]
