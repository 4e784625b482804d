"""What methods share that learn a latent space: the representation, and how it is looked at."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from numpy.typing import NDArray

from solar_cli.control.quadratic_cost import FittedCost, fit_quadratic_cost
from solar_cli.control.trajectories import Trajectories
from solar_cli.episodes import Episodes, Evaluation
from solar_cli.models.diagnostics import latent_metrics
from solar_cli.models.priors import Prior
from solar_cli.models.representation import Representation
from solar_cli.models.state_representation import StateRepresentation
from solar_cli.pulse import Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import CostFit, LatentMethod, StateMethod
from solar_cli.streams import Streams


class LatentLearner(ABC):
    """A learner with a representation, untrained at first."""

    def __init__(
        self,
        settings: StateMethod,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.settings = settings
        self.task = task
        self.streams = streams
        self.device = device
        self.pulse = pulse
        self.latent = settings.latents(task.observation)
        self.representation = self.make_representation()

    @abstractmethod
    def make_prior(self) -> Prior:
        """The prior over latents that the representation is trained with."""

    def make_representation(self) -> StateRepresentation:
        """An untrained representation."""
        return self.untrained(Representation)

    def untrained(self, kind: type[Representation]) -> Representation:
        """A representation of that kind, which is to be learned."""
        assert isinstance(self.settings, LatentMethod)
        return kind(
            self.settings,
            self.task,
            self.make_prior,
            self._cost_score,
            self.streams,
            self.device,
            self.pulse,
        )

    @property
    def cost_fit(self) -> CostFit:
        """How a quadratic cost is fitted: it tells whether a representation is good enough."""
        return CostFit()

    def fitted_cost(self, states: Trajectories, older: list[Trajectories]) -> FittedCost:
        """The quadratic cost of the newest latents (section 3)."""
        return fit_quadratic_cost(states, older, self.task.action_cost, self.cost_fit, self.latent)

    def _cost_score(self, representation: StateRepresentation, batches: list[Episodes]) -> float:
        states = [Trajectories.of(representation.embed(one).cpu(), one) for one in batches]
        return self.fitted_cost(Trajectories.joined(states), []).r2

    def diagnose(self, evaluation: Evaluation) -> dict[str, float]:
        """R2 of linear maps between true positions and the newest latents, both ways."""
        if not self.representation.trained or not evaluation.truth_names:
            return {}
        states = self.representation.embed(evaluation.episodes)[..., : self.latent]
        live = evaluation.episodes.live_frames
        latents = states.cpu().numpy()[live]
        return latent_metrics(latents, evaluation.truth[live], evaluation.truth_names)

    def encode(self, episodes: Episodes) -> NDArray[Any] | None:
        """Latents as control sees them, before whitening."""
        if not self.representation.trained:
            return None
        found: NDArray[Any] = self.representation.latents(episodes).cpu().numpy()
        return found

    def reconstruct(self, episodes: Episodes) -> NDArray[Any] | None:
        """Frames as the observation model expects them from the posterior's mean."""
        return self.representation.reconstruct(episodes) if self.representation.trained else None
