"""Reference policies that learn nothing: what a learned one must beat."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from solar_cli.episodes import Policy
from solar_cli.experience import Experience
from solar_cli.methods import Learner
from solar_cli.pulse import Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.reference import Reference
from solar_cli.streams import Streams

Floats = NDArray[np.float64]


class Fixed:
    """A `Policy` whose actions do not depend on what is seen, with noise or without."""

    def __init__(self, task: TaskSettings, streams: Streams | None) -> None:
        self._task = task
        # One stream for all groups of episodes, as there is of noise.
        self._draws = None if streams is None else streams.generator("without noise")

    def start(self, episodes: int, stream: np.random.Generator | None) -> Floats:
        """(N, T, a) the actions of whole episodes."""
        shape = (episodes, self._task.horizon, self._task.action.size)
        if self._draws is None:
            return np.zeros(shape)
        bound = self._task.action.bound
        draws = self._draws if stream is None else stream
        return draws.uniform(-bound, bound, shape)

    def act(self, observations: NDArray[Any], t: int, state: Floats) -> tuple[Floats, Floats, Any]:
        """As `Policy.act`."""
        return state[:, t], state[:, t], state


class Zero(Learner):
    """No action at all."""

    def __init__(
        self,
        settings: Reference,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.settings, self.task, self.streams = settings, task, streams

    @property
    def policy(self) -> Policy:
        """a_t = 0."""
        return Fixed(self.task, None)

    def iterate(self, experience: Experience) -> dict[str, float]:
        """Collect, so that its episodes stand beside those of learners."""
        experience.collect(self.policy, self.settings.episodes)
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing."""


class Random(Zero):
    """Uniform draws between the bounds of actions: Gymnasium's `action_space.sample`."""

    @property
    def policy(self) -> Policy:
        """a_t ~ U(-bound, bound), evaluated too: a policy without noise it has none."""
        return Fixed(self.task, self.streams)
