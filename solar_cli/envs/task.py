"""The one interface that a method meets, batched over episodes, and the class behind our own tasks.

Axes: N episodes, C channels, H rows, W columns, S entries of a state, a entries of an action,
k numbers that describe a simulator's state. Windows of frames are made by whoever needs them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from solar_cli.errors import UsageError, nearest
from solar_cli.settings import TaskSettings

Floats = NDArray[np.float64]
Frames = NDArray[Any]
"""(N, C, H, W) uint8 images or (N, S) float32 states; never shared between calls"""


class Task(Protocol):
    """An episodic control problem; episodes are run whole, all at once."""

    horizon: int
    """T: actions an episode has"""
    action_size: int
    action_bound: float
    """largest absolute value of an action entry; larger ones are clipped"""
    truth_names: tuple[str, ...]
    """what the columns of `truth` are"""
    at_once: int | None
    """episodes that may run side by side, or None for any number"""

    def reset(self, streams: Sequence[np.random.Generator]) -> Frames:
        """Start one episode for each stream, which alone decides its initial state."""

    def step(self, actions: Floats) -> tuple[Frames, Floats]:
        """Execute actions (N, a): the next frames, and the costs (N,) of state and action.

        The cost is that of the state before the step and of the action after clipping; minus the
        reward of a Gymnasium environment is mostly of the state after it. An episode that is over
        stays at its last frame; what such a step costs is the task's to say.
        """

    def ended(self) -> NDArray[np.bool_]:
        """Which episodes (N,) are over before the horizon."""

    def measures(self) -> dict[str, Floats]:
        """Ground truth of the current states, (N,) each; to judge a policy, never to learn from."""

    def truth(self) -> Floats:
        """True positions (N, len(truth_names)) of the current states, to diagnose latents with."""


class Restartable(Task, Protocol):
    """A task whose episodes may start anew one by one: what a Gymnasium vector needs."""

    def restart(self, which: NDArray[np.intp], streams: Sequence[np.random.Generator]) -> Frames:
        """Start new episodes in the rows ``which``, the others go on; returns the new frames."""


StateCost = Callable[[Any, Any], Any]
"""Costs (...) of states (..., S) as they are seen and actions (..., a), arrays or tensors alike."""


class RowSimulator(Protocol):
    """An own simulator: pure functions over rows (N, k), one row an episode."""

    truth_names: tuple[str, ...]

    def initial(self, stream: np.random.Generator) -> Floats:
        """The row (k,) that an episode starts from."""

    def dynamics(self, rows: Floats, actions: Floats) -> Floats:
        """The rows after actions (N, a), which are within their bounds."""

    def cost(self, rows: Floats, actions: Floats) -> Floats:
        """Costs (N,)."""

    def scenes(self, rows: Floats) -> Frames:
        """What every frame of an episode shows, drawn once an episode."""

    def draw(self, rows: Floats, scenes: Frames) -> Frames:
        """New frames: the scenes with what moves."""

    def measures(self, rows: Floats) -> dict[str, Floats]:
        """As `Task.measures`."""

    def truth(self, rows: Floats) -> Floats:
        """As `Task.truth`."""


class RowTask:
    """A `Task` made of a `RowSimulator`: it holds the rows and clips the actions."""

    at_once: int | None = None

    def __init__(self, simulator: RowSimulator, settings: TaskSettings) -> None:
        self.horizon = settings.horizon
        self.action_size = settings.action.size
        self.action_bound = settings.action.bound
        self.truth_names = simulator.truth_names
        self._simulator = simulator
        self._rows: Floats = np.empty((0, 0))
        self._scenes: Frames = np.empty((0, 0))

    def reset(self, streams: Sequence[np.random.Generator]) -> Frames:
        """As `Task.reset`."""
        # One draw a row, so that an episode does not depend on those beside it.
        self._rows = np.stack([self._simulator.initial(stream) for stream in streams])
        self._scenes = self._simulator.scenes(self._rows)
        return self._simulator.draw(self._rows, self._scenes)

    def restart(self, which: NDArray[np.intp], streams: Sequence[np.random.Generator]) -> Frames:
        """As `Restartable.restart`."""
        rows = np.stack([self._simulator.initial(stream) for stream in streams])
        scenes = self._simulator.scenes(rows)
        self._rows[which] = rows
        self._scenes[which] = scenes
        return self._simulator.draw(rows, scenes)

    def step(self, actions: Floats) -> tuple[Frames, Floats]:
        """As `Task.step`; raises `ValueError` for actions of another shape."""
        executed = _executed(actions, len(self._rows), self)
        costs = self._simulator.cost(self._rows, executed)
        self._rows = self._simulator.dynamics(self._rows, executed)
        return self._simulator.draw(self._rows, self._scenes), costs

    def ended(self) -> NDArray[np.bool_]:
        """As `Task.ended`: none."""
        return np.zeros(len(self._rows), np.bool_)

    def measures(self) -> dict[str, Floats]:
        """As `Task.measures`."""
        return self._simulator.measures(self._rows)

    def truth(self) -> Floats:
        """As `Task.truth`."""
        return self._simulator.truth(self._rows)


class Simulation(Protocol):
    """A simulator that keeps its state to itself, one episode at a time; made once, reset often."""

    truth_names: tuple[str, ...]

    def reset(self, stream: np.random.Generator) -> Frames:
        """Start an episode; its first frame, (C, H, W) or (S,)."""

    def step(self, action: Floats) -> tuple[Frames, float]:
        """Execute an action (a,) within its bounds: the next frame, and the cost as in `Task`."""

    def ended(self) -> bool:
        """As `Task.ended`, of this episode."""

    def measures(self) -> dict[str, float]:
        """As `Task.measures`, of this episode."""

    def truth(self) -> Floats:
        """As `Task.truth`, (k,)."""


class LoopTask:
    """A `Task` made of one `Simulation` for each episode that runs side by side."""

    at_once: int | None = 10  # a simulation may take 40 MB; more at once is hardly faster

    def __init__(self, make: Callable[[], Simulation], settings: TaskSettings) -> None:
        self.horizon = settings.horizon
        self.action_size = settings.action.size
        self.action_bound = settings.action.bound
        self._make = make
        self._spare = [make()]  # made at once: what is missing is said before anything runs
        self.truth_names = self._spare[0].truth_names
        self._running: list[Simulation] = []

    def reset(self, streams: Sequence[np.random.Generator]) -> Frames:
        """As `Task.reset`; simulations are used again, and made where there are too few."""
        every = self._running + self._spare
        every += [self._make() for _ in range(len(streams) - len(every))]
        self._running, self._spare = every[: len(streams)], every[len(streams) :]
        return self.restart(np.arange(len(streams)), streams)

    def restart(self, which: NDArray[np.intp], streams: Sequence[np.random.Generator]) -> Frames:
        """As `Restartable.restart`."""
        pairs = zip(which.tolist(), streams, strict=True)
        return np.stack([self._running[row].reset(stream) for row, stream in pairs])

    def step(self, actions: Floats) -> tuple[Frames, Floats]:
        """As `Task.step`; raises `ValueError` for actions of another shape."""
        executed = _executed(actions, len(self._running), self)
        stepped = [one.step(action) for one, action in zip(self._running, executed, strict=True)]
        return np.stack([frame for frame, _ in stepped]), np.array([cost for _, cost in stepped])

    def ended(self) -> NDArray[np.bool_]:
        """As `Task.ended`."""
        return np.array([one.ended() for one in self._running])

    def measures(self) -> dict[str, Floats]:
        """As `Task.measures`."""
        each = [one.measures() for one in self._running]
        return {name: np.array([values[name] for values in each]) for name in each[0]}

    def truth(self) -> Floats:
        """As `Task.truth`."""
        return np.stack([one.truth() for one in self._running])


def _executed(actions: Floats, episodes: int, task: Task) -> Floats:
    """Actions within their bounds; raises `ValueError` for another shape."""
    if actions.shape != (expected := (episodes, task.action_size)):
        raise ValueError(
            f"actions have shape {actions.shape}, expected {expected}: reset first, then give "
            "one action for each episode"
        )
    return np.clip(actions, -task.action_bound, task.action_bound)


def check_parameters(settings: TaskSettings, known: Iterable[str]) -> None:
    """Refuse parameters that the simulator does not know, with a `UsageError`."""
    known = tuple(known)
    for name in settings.parameters:
        if name not in known:
            raise UsageError(
                f"task.parameters: simulator {settings.simulator!r} has no parameter {name!r}: "
                f"{nearest(name, known)}"
            )
