"""A learned representation as control uses it: trained, watched, repaired, and then embedded with.

A training can end with dead latents: what it reconstructs, and how well a quadratic of its latents
explains the collected costs, tells. Then it is trained anew from other weights, a few times at
most, and the best by held-out collected episodes is kept. Nothing here sees an evaluation.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from solar_cli.episodes import Environment, Episodes, window_indices
from solar_cli.models.basis import LatentBasis, LatentPrior
from solar_cli.models.frames import FrameModel
from solar_cli.models.latent_model import LatentModel
from solar_cli.models.likelihoods import explained_variance
from solar_cli.models.priors import Prior
from solar_cli.models.training import Trainer
from solar_cli.pulse import Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import LocalMethod
from solar_cli.streams import Streams

ACTIVE_SHARE = 0.1  # of a latent's variance that its mean must carry for it to count as active
LEAST_EXPLAINED = 0.5  # of the variance of each channel
LEAST_COST_R2 = 0.5

CostScore = Callable[[Tensor, Episodes], float]
"""R2 of the cost that control would fit on states (N, T+1, z) of these episodes."""


class Candidate(NamedTuple):
    """One training of the representation, judged on held-out episodes."""

    loss: float
    """negative ELBO, nats a frame"""
    healthy: bool
    metrics: dict[str, float]
    state: dict[str, Any]


class Representation:
    """Encoder, decoder and latent prior; `embed` gives the states that control works in."""

    def __init__(
        self,
        settings: LocalMethod,
        task: TaskSettings,
        make_prior: Callable[[], Prior],
        cost_score: CostScore,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.settings = settings
        self.task = task
        self.device = device
        self.moved = False
        """whether the last update changed what states mean"""
        self._make_prior = make_prior
        self._cost_score = cost_score
        self._streams = streams
        self._pulse = pulse
        self._trainer = Trainer(settings.training, streams, device, pulse)
        self._model = self._untrained(0)
        self._basis: LatentBasis | None = None
        self._trained = False
        self._candidates: list[Candidate] = []

    @property
    def trained(self) -> bool:
        """Whether there is something to embed with."""
        return self._trained

    @property
    def basis(self) -> LatentBasis:
        """From windows of latents to states; fixed after the first training."""
        assert self._basis is not None
        return self._basis

    @property
    def dynamics_prior(self) -> LatentPrior:
        """What the model knows of its dynamics, for INFERDYNAMICS."""
        return LatentPrior(self._model.prior.factor, self.basis, self.latent)

    @property
    def latent(self) -> int:
        """d: latents of one frame."""
        return self.settings.representation.latent

    @property
    def state_size(self) -> int:
        """z: entries of a state."""
        return self.latent * self.task.observation.window

    def update(self, environment: Environment) -> dict[str, float]:
        """MODELUPDATE (Algorithm 1, line 5): train on the batches of the last B iterations."""
        recent = environment.recent(self.settings.training.buffer)
        newest = recent[-1]
        started = time.perf_counter()
        steps = self.settings.training.fine_tune_steps
        if not self.trained:
            metrics = self._train_first(newest)
            self.moved = True
        elif steps:
            name = f"iteration {environment.iteration}"
            metrics = self._trainer.fit(name, self._model, recent, steps, fine_tuning=True)
            metrics |= self._judge(newest)
            self.moved = True
        else:
            self._model.prior.condition(self._model.posterior(Episodes.joined(recent), self.device))
            metrics = self._judge(newest)
            self.moved = False
        return {
            **metrics,
            **self._model.prior.metrics(),
            "seconds_model": time.perf_counter() - started,
        }

    def _train_first(self, episodes: Episodes) -> dict[str, float]:
        """Train until a representation is alive, or take the best of the attempts."""
        training = self.settings.training
        kept = max(1, round(training.held_out * len(episodes)))
        learned, held_out = episodes[:-kept], episodes[-kept:]
        while len(self._candidates) < training.attempts and not self._found():
            attempt = len(self._candidates)
            if not self._trainer.under_way:
                self._model = self._untrained(attempt)
                self._model.networks.standardise_by(self._frames(learned))
            started = time.perf_counter()
            terms = self._trainer.fit(f"attempt {attempt}", self._model, [learned], training.steps)
            self._basis = self._whitening(learned)
            metrics = self._judge(held_out)
            self._candidates.append(
                Candidate(
                    loss=metrics["held_out_loss"],
                    healthy=metrics["healthy"] == 1.0,
                    metrics={**terms, **metrics, "seconds_training": time.perf_counter() - started},
                    state=self._parameters(),
                )
            )
        best = min(self._candidates, key=lambda c: (not c.healthy, c.loss))
        seconds = sum(candidate.metrics["seconds_training"] for candidate in self._candidates)
        discarded = {
            "discarded_trainings": len(self._candidates) - 1.0,
            "seconds_discarded": seconds - best.metrics["seconds_training"],
        }
        self._take_up(best.state)
        self._trained = True
        self._candidates = []
        return {**best.metrics, **discarded}

    def _found(self) -> bool:
        return any(candidate.healthy for candidate in self._candidates)

    @torch.no_grad()
    def _judge(self, episodes: Episodes) -> dict[str, float]:
        """What there is to watch, on episodes that count: ELBO, live latents, explained pixels."""
        model, basis = self._model, self.basis
        segments = model.posterior(episodes, self.device)
        scaled = model.networks.scaled(self._frames(episodes))
        means = segments.mean.flatten(0, 1)
        reconstruction = model.networks.reconstruction_loss(means.float(), scaled)
        kl = model.prior.kl(segments)
        explained = explained_variance(model.networks.reconstruct(scaled), scaled)
        spread = means.var(dim=0)
        share = spread / (spread + segments.variance.flatten(0, 1).mean(dim=0))
        r2 = self._cost_score(basis.state(self._windows(segments.mean)), episodes)
        least = float(explained.min())
        return {
            "held_out_loss": float(reconstruction) + float(kl),
            "held_out_kl": float(kl),
            "explained_variance": least,
            "active_latents": float((share > 1 - ACTIVE_SHARE).sum()),
            "latent_cost_r2": r2,
            "healthy": float(least >= LEAST_EXPLAINED and r2 >= LEAST_COST_R2),
        }

    @torch.no_grad()
    def embed(self, episodes: Episodes) -> Float[Tensor, "N T1 z"]:
        """States of every step, by the encoder's mean; each frame is encoded once."""
        mean = self._model.posterior(episodes, self.device).mean
        return self.basis.state(self._windows(mean))

    @torch.no_grad()
    def encode(self, frames: np.ndarray[Any, Any]) -> Float[Tensor, "n d"]:
        """Latents of single frames (n, *frame), by the encoder's mean."""
        tensor = torch.from_numpy(np.ascontiguousarray(frames)).to(self.device)
        return self._model.embed(tensor)[0]

    @torch.no_grad()
    def reconstruct(self, episodes: Episodes) -> np.ndarray[Any, Any]:
        """Expected frames, in the shape and units of ``episodes.frames``."""
        networks = self._model.networks
        scaled = networks.scaled(self._frames(episodes))
        frames = networks.as_frames(networks.reconstruct(scaled))
        return frames.cpu().numpy().reshape(episodes.frames.shape)

    def state_dict(self) -> dict[str, Any]:
        """Networks, factors, basis, a training under way and the candidates so far."""
        return {
            "parameters": self._parameters(),
            "trainer": self._trainer.state_dict(),
            "candidates": [tuple(candidate) for candidate in self._candidates],
            "trained": self._trained,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self._take_up(state["parameters"])
        self._trainer.load_state_dict(state["trainer"])
        self._candidates = [Candidate(*candidate) for candidate in state["candidates"]]
        self._trained = state["trained"]

    def _untrained(self, attempt: int) -> LatentModel:
        """Fresh networks whose weights depend on the seed and the attempt only."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self._streams.seed63("weights", attempt))
            networks = FrameModel(self.settings.representation, self.task.observation)
        return LatentModel(
            networks.to(self.device), self._make_prior(), self.settings.training.standard_normal
        )

    def _frames(self, episodes: Episodes) -> Tensor:
        frames = torch.from_numpy(np.ascontiguousarray(episodes.frames))
        return frames.flatten(0, 1).to(self.device)

    def _windows(self, latents: Float[Tensor, "N T1 d"]) -> Float[Tensor, "N T1 W d"]:
        """The newest frame first."""
        index = window_indices(latents.shape[1] - 1, self.task.observation.window)
        return latents[:, torch.from_numpy(index[:, ::-1].copy()).to(latents.device)]

    def _whitening(self, episodes: Episodes) -> LatentBasis:
        mean = self._model.posterior(episodes, self.device).mean
        return LatentBasis.whitening(self._windows(mean).flatten(0, 1))

    def _parameters(self) -> dict[str, Any]:
        networks = {
            name: value.detach().clone()
            for name, value in self._model.networks.state_dict().items()
        }
        basis = None if self._basis is None else list(self._basis)
        return {"networks": networks, "prior": self._model.prior.state_dict(), "basis": basis}

    def _take_up(self, parameters: dict[str, Any]) -> None:
        self._model.networks.load_state_dict(parameters["networks"])
        self._model.prior.load_state_dict(parameters["prior"])
        basis = parameters["basis"]
        self._basis = None if basis is None else LatentBasis(*(b.to(self.device) for b in basis))
