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

    def follow(
        self, frames: NDArray[Any], t: int, belief: Any, actions: Float[Tensor, "N a"] | None
    ) -> tuple[Float[Tensor, "N d"], Any]:
        """Latents of the newest frames, and the belief for the next step.

        ``belief`` and ``actions`` are the step before's, None at the start.
        """


class Followed(NamedTuple):
    """What is carried of an episode's frames."""

    latents: tuple[Tensor, ...] = ()
    """(N, d) of the window's frames, newest first"""
    belief: Any = None
    """what the embedding carries"""


def latest_state(
    embedding: Embedding,
    observations: NDArray[Any],
    t: int,
    before: Followed,
    actions: Float[Tensor, "N a"] | None,
    window: int,
) -> tuple[Float[Tensor, "N z"], Followed]:
    """The state that windows of frames end in, and what is to be given with the next ones.

    Only the newest frame is encoded; ``actions`` are those of the step before, None at the start.
    """
    newest, belief = embedding.follow(observations[:, -1], t, before.belief, actions)
    # Before the start of an episode its first frame repeats.
    latents = (newest, *(before.latents or (newest,) * window))[:window]
    return embedding.basis.state(torch.stack(latents, dim=1)), Followed(latents, belief)


class Acting(NamedTuple):
    """What is carried through an episode."""

    noise: Float[Tensor, "N T a"] | None
    """unit-variance noise, or None for a noise-free policy"""
    followed: Followed = Followed()
    actions: Float[Tensor, "N a"] | None = None
    """of the step before"""


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
            return Acting(None)
        horizon, size = self.gains.k.shape
        noise = smooth_noise((episodes, horizon, size), self.smoothing, stream)
        return Acting(torch.from_numpy(noise))

    def act(
        self, observations: NDArray[Any], t: int, state: Acting
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], Acting]:
        """Actions, their means and the state; only the newest frame is encoded."""
        mean = self.gains.k[t].expand(len(observations), -1)
        followed = state.followed
        if self.embedding.trained:
            z, followed = latest_state(
                self.embedding, observations, t, followed, state.actions, self.window
            )
            mean = z.cpu() @ self.gains.K[t].T + self.gains.k[t]
        action = mean
        if state.noise is not None:
            action = mean + state.noise[:, t] @ self._spread[t].T
        acted = Acting(state.noise, followed, action)
        return action.numpy().copy(), mean.numpy().copy(), acted
