"""The latent variable model of section 3: frame networks, a prior over latents, and their ELBO."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from solar_cli.episodes import Episodes
from solar_cli.models.frames import CHUNK, FrameModel
from solar_cli.models.priors import Prior, Segments, standard_normal_kl


class Minibatch(NamedTuple):
    """Segments of consecutive frames, and what is random about a step."""

    frames: Tensor
    """(S, L, *frame) as stored"""
    actions: Float[Tensor, "S L_1 a"]
    start: Tensor
    """(S,) time step of the first frame"""
    noise: Float[Tensor, "S L d"]
    """standard normal draws for the sample of q(z | s)"""
    decoded: Tensor
    """numbers of the frames, of S L, that are decoded"""
    starts: Tensor | None = None
    """(S,) segments of this length that each one's episode has; None for a whole episode's"""


class LatentModel:
    """q(z | s), p(s | z) and the prior over z."""

    def __init__(self, networks: FrameModel, prior: Prior, standard_normal: float) -> None:
        self.networks = networks
        self.prior = prior
        self.standard_normal = standard_normal

    def parameters(self) -> list[nn.Parameter]:
        """What Adam trains."""
        return [*self.networks.parameters(), *self.prior.parameters()]

    def loss(self, batch: Minibatch, kl_weight: float) -> tuple[Tensor, Any, dict[str, Tensor]]:
        """The negative ELBO in nats a frame, what the prior learns from, and the ELBO's terms.

        The prior's KL terms weigh every time step of an episode alike; the reconstruction is a mean
        over the frames that were drawn, of which the first and last of an episode are fewer.
        """
        scaled = self.networks.scaled(batch.frames.flatten(0, 1))
        shape = (*batch.frames.shape[:2], -1)
        mean, variance = (part.view(shape) for part in self.networks.encode(scaled))
        encoded = Segments(mean, variance, batch.actions, batch.start, starts=batch.starts)
        sample, segments = self.prior.sampled(encoded, batch.noise)
        reconstruction = self.networks.reconstruction_loss(
            sample.flatten(0, 1).index_select(0, batch.decoded),
            scaled.index_select(0, batch.decoded),
        )
        statistics = self.prior.statistics(segments)
        kl = self.prior.kl(statistics)
        loss = reconstruction + kl_weight * kl
        if self.standard_normal:
            spread = standard_normal_kl(segments.mean, segments.variance).mean()
            loss = loss + kl_weight * self.standard_normal * spread
        return loss, statistics, {"elbo_reconstruction": -reconstruction, "elbo_kl": kl}

    @torch.no_grad()
    def embed(self, frames: Tensor) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d"]]:
        """The encoder's mean and variance, float64, for frames as stored; each frame once."""
        parts = [
            self.networks.encode(self.networks.scaled(chunk))
            for chunk in torch.split(frames, CHUNK)
        ]
        mean, variance = (torch.cat(part).double() for part in zip(*parts, strict=True))
        return mean, variance

    def encoded(self, episodes: Episodes, device: str) -> Segments:
        """What the encoder says of the frames of whole episodes, each as one segment."""
        frames = torch.from_numpy(np.ascontiguousarray(episodes.frames)).to(device)
        mean, variance = self.embed(frames.flatten(0, 1))
        shape = (*frames.shape[:2], -1)
        live = episodes.live_frames
        return Segments(
            mean.view(shape),
            variance.view(shape),
            torch.from_numpy(episodes.actions).to(device),
            torch.zeros(len(episodes), dtype=torch.long, device=device),
            None if live.all() else torch.from_numpy(live).to(device),
        )
