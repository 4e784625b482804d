"""Random search: the gains of a linear policy, found by the cross-entropy method from costs alone.

What the policy sees of an image is where the brightness of each channel has its centre.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from solar_cli.episodes import Environment, Episodes, Evaluation
from solar_cli.methods import Pulse
from solar_cli.settings import MethodEntry, TaskSettings
from solar_cli.settings.local import Budget
from solar_cli.settings.schema import Settings, setting
from solar_cli.streams import Streams

Floats = NDArray[np.float64]

ENTRY = MethodEntry(
    name="random-search",
    summary="The gains of a linear policy by the cross-entropy method.",
    source="Rubinstein and Kroese 2004",
    settings="solar_random_search:RandomSearchSettings",
    learner="solar_random_search:RandomSearch",
)


class RandomSearchSettings(Settings):
    """What a card may say under [methods.random-search]."""

    budget: Budget = setting(Budget(desk=400, full=2000), "where to stop", presentation=True)
    population: int = setting(20, "policies tried in an iteration, one episode each", ge=4)
    elite: int = setting(5, "best policies that the next population is drawn around", ge=2)
    spread: float = setting(1.0, "initial standard deviation of a gain", gt=0)


def features(observations: NDArray[Any]) -> Floats:
    """(N, k) what is seen of windows (N, W, *frame): the newest frame's centres, and a 1."""
    newest = observations[:, -1].astype(np.float64)
    if newest.ndim == 4:  # images (N, C, H, W): rows and columns of the centres, in [-1, 1]
        weights = newest / np.maximum(newest.sum(axis=(2, 3), keepdims=True), 1.0)
        rows, columns = np.linspace(-1, 1, newest.shape[2]), np.linspace(-1, 1, newest.shape[3])
        newest = np.hstack([weights.sum(axis=3) @ rows, weights.sum(axis=2) @ columns])
    return np.hstack([newest, np.ones((len(newest), 1))])


class LinearPolicy:
    """Actions = gains x features, with gains (N, a, k) of their own for each of N episodes."""

    def __init__(self, gains: Floats) -> None:
        self.gains = gains

    def start(self, episodes: int, stream: np.random.Generator | None) -> Floats:
        """No noise: the gains differ between episodes instead. One set serves them all."""
        return np.broadcast_to(self.gains, (episodes, *self.gains.shape[1:]))

    def act(self, observations: NDArray[Any], t: int, state: Floats) -> tuple[Floats, Floats, Any]:
        """Actions, the same without noise, and the gains for the next step."""
        actions = np.einsum("nak,nk->na", state, features(observations))
        return actions, actions, state


class RandomSearch:
    """The learner: one iteration tries a population and moves towards its best."""

    def __init__(
        self,
        settings: RandomSearchSettings,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.settings, self.streams, self.pulse = settings, streams, pulse
        seen = task.observation
        size = 1 + (2 * seen.channels if seen.kind == "image" else seen.width)
        self.mean: Floats = np.zeros((task.action.size, size))
        self.std: Floats = np.full_like(self.mean, settings.spread)

    @property
    def policy(self) -> LinearPolicy:
        """The policy that it would hand over now."""
        return LinearPolicy(self.mean[None])

    def iterate(self, environment: Environment) -> dict[str, float]:
        """Try a population, one episode each, and fit the next one to its elite."""
        self.pulse("trying policies", 0.0)
        stream = self.streams.generator("population", environment.iteration)
        noise = stream.standard_normal((self.settings.population, *self.mean.shape))
        gains = self.mean + self.std * noise
        episodes = environment.collect(LinearPolicy(gains), len(gains))
        elite = gains[np.argsort(episodes.costs.sum(axis=1))[: self.settings.elite]]
        self.mean, self.std = elite.mean(axis=0), elite.std(axis=0)
        return {"spread": float(self.std.mean())}

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next iteration depends on."""
        return {"mean": self.mean.tolist(), "std": self.std.tolist()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self.mean, self.std = np.array(state["mean"]), np.array(state["std"])

    def diagnose(self, evaluation: Evaluation) -> dict[str, float]:
        """It has no representation to judge."""
        return {}

    def reconstruct(self, episodes: Episodes) -> NDArray[Any] | None:
        """It has no model of images."""
        return None
