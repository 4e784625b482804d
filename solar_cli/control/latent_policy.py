"""A linear-Gaussian policy on the states that a representation makes of observations."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from solar_cli.control.exploration import smooth_noise
from solar_cli.control.linear_gaussian import LinearGaussianPolicy
from solar_cli.models.basis import LatentBasis


class Embedding(Protocol):
    """What a policy asks of a representation."""

    @property
    def trained(self) -> bool:
        """Whether there is something to embed with."""

    @property
    def basis(self) -> LatentBasis:
        """From windows of latents to states."""

    def encode(self, frames: NDArray[Any]) -> Float[Tensor, "n d"]:
        """Latents of single frames."""


def latest_state(
    embedding: Embedding, observations: NDArray[Any], latents: tuple[Tensor, ...], window: int
) -> tuple[Float[Tensor, "N z"], tuple[Tensor, ...]]:
    """The state that windows of frames end in, given the ``latents`` of the frames before.

    Only the newest frame is encoded; the second result is to be given with the next observation.
    """
    newest = embedding.encode(observations[:, -1])
    # Before the start of an episode its first frame repeats.
    latents = (newest, *(latents or (newest,) * window))[:window]
    return embedding.basis.state(torch.stack(latents, dim=1)), latents


class Acting(NamedTuple):
    """What is carried through an episode."""

    noise: Float[Tensor, "N T a"] | None
    """unit-variance noise, or None for a noise-free policy"""
    latents: tuple[Tensor, ...]
    """(N, d) latents of the window's frames, newest first"""


class LatentPolicy:
    """a_t ~ N(K_t z_t + k_t, S_t), z_t the state of the window of frames that end at t."""

    def __init__(
        self, gains: LinearGaussianPolicy, embedding: Embedding, window: int, smoothing: float
    ) -> None:
        self.gains = gains
        self.embedding = embedding
        self.window = window
        self.smoothing = smoothing
        self._spread = torch.linalg.cholesky(gains.S)

    def start(self, episodes: int, stream: np.random.Generator | None) -> Acting:
        """Draw the noise of whole episodes."""
        if stream is None:
            return Acting(None, ())
        horizon, size = self.gains.k.shape
        noise = smooth_noise((episodes, horizon, size), self.smoothing, stream)
        return Acting(torch.from_numpy(noise), ())

    def act(
        self, observations: NDArray[Any], t: int, state: Acting
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], Acting]:
        """Actions, their means and the state; only the newest frame is encoded."""
        mean = self.gains.k[t].expand(len(observations), -1)
        latents = state.latents
        if self.embedding.trained:
            z, latents = latest_state(self.embedding, observations, latents, self.window)
            mean = z.cpu() @ self.gains.K[t].T + self.gains.k[t]
        action = mean
        if state.noise is not None:
            action = mean + state.noise[:, t] @ self._spread[t].T
        return action.numpy(), mean.numpy().copy(), Acting(state.noise, latents)
