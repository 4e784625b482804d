"""Random search: the gains of a linear policy, found from costs alone (Mania et al. 2018).

What the policy sees of an image is where the brightness of each channel has its centre.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from solar_cli.episodes import Episodes, Evaluation
from solar_cli.experience import Experience
from solar_cli.methods import Pulse
from solar_cli.settings import MethodEntry, TaskSettings
from solar_cli.settings.local import Budget
from solar_cli.settings.schema import Settings, setting
from solar_cli.streams import Streams

Floats = NDArray[np.float64]

ENTRY = MethodEntry(
    name="random-search",
    summary="The gains of a linear policy, moved against the costs of random changes to them.",
    source="Mania et al. 2018",
    settings="solar_random_search:RandomSearchSettings",
    learner="solar_random_search:RandomSearch",
)


class RandomSearchSettings(Settings):
    """What a card may say under [methods.random-search]."""

    budget: Budget = setting(Budget(desk=1000, full=5000), "where to stop", presentation=True)
    population: int = setting(50, "changes tried in an iteration, one episode each", ge=2)
    spread: float = setting(0.5, "standard deviation of a change to a gain", gt=0)
    rate: float = setting(1.0, "step along the changes that lowered the cost", gt=0)


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
    """The learner: one iteration tries a population of changes and steps against their costs."""

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
        self.gains: Floats = np.zeros((task.action.size, size))

    @property
    def policy(self) -> LinearPolicy:
        """The policy that it would hand over now."""
        return LinearPolicy(self.gains[None])

    def iterate(self, experience: Experience) -> dict[str, float]:
        """Try a population, one episode each; costs count by their rank, so no scale matters."""
        self.pulse("trying changes", 0.0)
        stream = self.streams.generator("changes", experience.iteration)
        changes = stream.standard_normal((self.settings.population, *self.gains.shape))
        tried = LinearPolicy(self.gains + self.settings.spread * changes)
        episodes = experience.collect(tried, len(changes))
        ranks = episodes.costs.sum(axis=1).argsort().argsort()
        score = (ranks - ranks.mean()) / ranks.std()
        step = np.einsum("n,nak->ak", score, changes) / len(changes)
        self.gains = self.gains - self.settings.rate * self.settings.spread * step
        return {"step": float(np.linalg.norm(step))}

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next iteration depends on."""
        return {"gains": self.gains.tolist()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self.gains = np.array(state["gains"])

    def diagnose(self, evaluation: Evaluation) -> dict[str, float]:
        """It has no representation to judge."""
        return {}

    def encode(self, episodes: Episodes) -> NDArray[Any] | None:
        """It has no latents."""
        return None

    def reconstruct(self, episodes: Episodes) -> NDArray[Any] | None:
        """It has no model of images."""
        return None
