"""A method at work on the smoke variant of nav, or of a task that it can do, made smaller still."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from bits import digest, through_a_file

from solar_cli.envs import build_task
from solar_cli.experience import Environment, Experience
from solar_cli.settings import cells, load, load_card, method
from solar_cli.streams import Streams

LOCAL = ("training.steps=12", 'cost_fit.per_time="never"')
"""what makes a local method's iterations short"""
SMALL: dict[str, tuple[str, ...]] = {
    "lqr-flm": ('cost_fit.per_time="never"',),
    "global-mpc": ("training.steps=12", "network.steps=12", "planner.horizon=3"),
    "mpc-nn": ("network.steps=12",),
    "pixel-mpc": (),
    "ppo": (),
    "random": (),
    "trpo": (),
    "zero": (),
}
"""the same for others"""
TASKS = {"mpc-nn": "car-states"}


class Run:
    """One cell: its environment, its learner, and what each iteration returned.

    ``costs`` changes those of an iteration, given its number.
    """

    def __init__(
        self,
        folder: Path,
        name: str = "solar",
        *sets: str,
        seed: int = 0,
        pulse: Callable[[str, float], None] = lambda *_: None,
        wrap: Callable[[Any], Any] = lambda task: task,
        costs: Callable[[int, np.ndarray], np.ndarray] | None = None,
    ) -> None:
        small = (*SMALL.get(name, LOCAL), *sets)
        changes = ["task.horizon=6", *(f"methods.{name}.{text}" for text in small)]
        [cell] = cells(load_card(TASKS.get(name, "nav")), name, [seed], "smoke", changes)
        self.configuration = cell.configuration
        streams, settings = Streams(seed), cell.configuration.task
        simulator = wrap(build_task(settings))
        if costs is not None:
            simulator = Costing(simulator, lambda c: costs(self.environment.iteration, c))
        self.environment = Environment(simulator, settings, streams.under("environment"), folder)
        self.learner = load(method(name).learner)(
            cell.configuration.method, settings, streams.under("learner"), "cpu", pulse
        )
        self.metrics: list[dict[str, float]] = []

    def iterate(self, first: int, last: int) -> Run:
        """Iterations ``first`` to ``last``; wall-clock is left out of what they return."""
        for iteration in range(first, last + 1):
            self.environment.begin(iteration)
            metrics = self.learner.iterate(Experience(self.environment))
            self.metrics.append({k: v for k, v in metrics.items() if not k.startswith("seconds_")})
        return self

    def state(self) -> dict[str, Any]:
        """What a checkpoint holds, as a file gives it back."""
        parts = {"learner": self.learner.state_dict(), "environment": self.environment.state_dict()}
        state: dict[str, Any] = through_a_file(parts)
        return state

    def restore(self, state: dict[str, Any]) -> Run:
        """Take up what a checkpoint holds."""
        self.environment.load_state_dict(state["environment"])
        self.learner.load_state_dict(state["learner"])
        return self

    def bits(self) -> str:
        """SHA-256 of all state."""
        return digest(self.state())


class Costing:
    """A task whose costs are changed on the way to the learner."""

    def __init__(self, task: Any, change: Callable[[np.ndarray], np.ndarray]) -> None:
        self._task, self._change = task, change

    def __getattr__(self, name: str) -> Any:
        return getattr(self._task, name)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        frames, costs = self._task.step(actions)
        return frames, self._change(costs)
