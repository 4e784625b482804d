"""Reference policies that learn nothing: what a learned one must beat."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solar_cli.episodes import Episodes, Evaluation, Experience, Policy
from solar_cli.pulse import Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.reference import Reference as ReferenceSettings
from solar_cli.streams import Streams

Floats = NDArray[np.float64]


class Fixed:
    """A `Policy` whose actions do not depend on what is seen, with noise or without."""

    def __init__(self, task: TaskSettings, streams: Streams | None) -> None:
        self._task, self._streams = task, streams

    def start(self, episodes: int, stream: np.random.Generator | None) -> Floats:
        """(N, T, a) the actions of whole episodes."""
        shape = (episodes, self._task.horizon, self._task.action.size)
        if self._streams is None:
            return np.zeros(shape)
        bound = self._task.action.bound
        draws = stream if stream is not None else self._streams.generator("without noise")
        return draws.uniform(-bound, bound, shape)

    def act(self, observations: NDArray[Any], t: int, state: Floats) -> tuple[Floats, Floats, Any]:
        """As `Policy.act`."""
        return state[:, t], state[:, t], state


class Reference(ABC):
    """A learner that collects and stays as it is."""

    def __init__(
        self,
        settings: ReferenceSettings,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.settings, self.task, self.streams = settings, task, streams

    @property
    @abstractmethod
    def policy(self) -> Policy:
        """The policy, which never changes."""

    def iterate(self, experience: Experience) -> dict[str, float]:
        """Collect, so that its episodes stand beside those of learners."""
        experience.collect(self.policy, self.settings.episodes)
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing."""

    def diagnose(self, evaluation: Evaluation) -> dict[str, float]:
        """It has no representation to judge."""
        return {}

    def encode(self, episodes: Episodes) -> None:
        """It has no latents."""

    def reconstruct(self, episodes: Episodes) -> None:
        """It has no model."""


class Zero(Reference):
    """No action at all."""

    @property
    def policy(self) -> Policy:
        """a_t = 0."""
        return Fixed(self.task, None)


class Random(Reference):
    """Uniform draws between the bounds of actions: Gymnasium's `action_space.sample`."""

    @property
    def policy(self) -> Policy:
        """a_t ~ U(-bound, bound), drawn anew for each evaluation's episodes."""
        return Fixed(self.task, self.streams)
