"""What methods share that learn a latent space: the representation, and how it is looked at."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from numpy.typing import NDArray

from solar_cli.episodes import Episodes, Evaluation
from solar_cli.models.diagnostics import latent_metrics
from solar_cli.models.priors import Prior
from solar_cli.models.representation import Representation
from solar_cli.pulse import Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import LatentMethod
from solar_cli.streams import Streams


class LatentLearner(ABC):
    """A learner with a representation, untrained at first."""

    def __init__(
        self,
        settings: LatentMethod,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.task = task
        self.streams = streams
        self.device = device
        self.pulse = pulse
        self.latent = settings.representation.latent
        self.representation = self.make_representation()

    @abstractmethod
    def make_representation(self) -> Representation:
        """An untrained representation."""

    @abstractmethod
    def make_prior(self) -> Prior:
        """The prior over latents that the representation is trained with."""

    def diagnose(self, evaluation: Evaluation) -> dict[str, float]:
        """R2 of linear maps between true positions and the newest latents, both ways."""
        if not self.representation.trained or not evaluation.truth_names:
            return {}
        states = self.representation.embed(evaluation.episodes)[..., : self.latent]
        live = evaluation.episodes.live_frames
        latents = states.cpu().numpy()[live]
        return latent_metrics(latents, evaluation.truth[live], evaluation.truth_names)

    def encode(self, episodes: Episodes) -> NDArray[Any] | None:
        """Latents by the encoder's mean, as they are before whitening."""
        if not self.representation.trained:
            return None
        every = episodes.frames.reshape(-1, *episodes.frames.shape[2:])
        latents = self.representation.encode(every).cpu().numpy()
        return latents.reshape(*episodes.frames.shape[:2], -1)

    def reconstruct(self, episodes: Episodes) -> NDArray[Any] | None:
        """Frames as the observation model expects them from the encoder's mean."""
        return self.representation.reconstruct(episodes) if self.representation.trained else None
