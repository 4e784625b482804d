"""States without learning: observed states as they are, images by their principal components.

Nothing is trained. What there is to know of a task, the principal components of images and the
scales of whitening, comes from the first batch, and stays.

Axes: N episodes, T actions an episode, P numbers of a frame, d latents, W frames of a window.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from solar_cli.episodes import Episodes
from solar_cli.experience import Experience
from solar_cli.models.basis import LatentBasis, windows_of
from solar_cli.models.likelihoods import explained_variance
from solar_cli.models.priors import LatentPrior
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import LqrFlm

CHUNK = 512  # frames in floating point at once: bounds memory
MOST_FRAMES = 2000  # that components are found in, and judged by: a matrix has a row for each
LEAST_SHARE = 1e-6  # of the largest component's variance: smaller ones are float32's rounding
LEAST_STD = 1e-6  # of an entry of a state, as for networks: a smaller one is constant


class Projection:
    """Affine latents of frames, and states of windows of them; see `StateRepresentation`."""

    def __init__(self, settings: LqrFlm, task: TaskSettings, device: str) -> None:
        self.settings = settings
        self.task = task
        self.device = device
        self.moved_in = 0
        self.latent = settings.latents(task.observation)
        """d: latents of one frame"""
        self._image = task.observation.kind == "image"
        size = int(np.prod(task.observation.frame_shape))
        self._centre = torch.zeros(size, device=device)
        self._components = torch.eye(size, self.latent, device=device)
        self._basis: LatentBasis | None = None

    @property
    def trained(self) -> bool:
        """Whether there is something to embed with."""
        return self._basis is not None

    @property
    def basis(self) -> LatentBasis:
        """From windows of latents to states; fixed after the first batch."""
        assert self._basis is not None
        return self._basis

    @property
    def state_size(self) -> int:
        """z: entries of a state."""
        return self.latent * self.task.observation.window

    def update(self, experience: Experience) -> dict[str, float]:
        """Components and scales of the first batch; how well the newest one is described."""
        newest = Episodes.joined(experience.recent(1))
        live = newest.frames[newest.live_frames]
        some = self._flat(live[:: -(-len(live) // MOST_FRAMES)])
        if not self.trained:
            if self._image:
                self._centre, self._components = principal_components(some, self.latent)
            self._basis = self._basis_of(newest)
            self.moved_in = experience.iteration
        if not self._image:
            return {}
        frame = self.task.observation.frame_shape
        expected = self._frames_of(self._latents(some))
        explained = explained_variance(expected.view(-1, *frame), some.view(-1, *frame))
        return {"least_explained_variance": float(explained.min())}

    def dynamics_prior(self, older: list[Episodes], *, as_it_stands: bool) -> LatentPrior:
        """Nothing is known of dynamics."""
        return LatentPrior(None, LatentBasis(*(part.cpu() for part in self.basis)), self.latent)

    def embed(self, episodes: Episodes) -> Float[Tensor, "N T1 z"]:
        """States of every step."""
        return self.basis.state(self._windows(episodes))

    def latents(self, episodes: Episodes) -> Float[Tensor, "N T1 d"]:
        """Latents of every frame."""
        every = episodes.frames.reshape(-1, *episodes.frames.shape[2:])
        return self._encoded(every).view(*episodes.frames.shape[:2], -1)

    def follow(
        self,
        frames: np.ndarray[Any, Any],
        t: int,
        belief: Any,
        actions: Float[Tensor, "N a"] | None,
    ) -> tuple[Float[Tensor, "N d"], Any]:
        """Latents of the newest frames; nothing is carried."""
        return self._encoded(frames), None

    def reconstruct(self, episodes: Episodes) -> np.ndarray[Any, Any]:
        """Frames as components tell them, in the shape and units of ``episodes.frames``."""
        flat = self._frames_of(self._latents(self._flat(episodes.frames)))
        if self._image:
            flat = (255.0 * flat).round().clamp(0, 255)
        frames = flat.cpu().numpy().astype(episodes.frames.dtype)
        return frames.reshape(episodes.frames.shape)

    def state_dict(self) -> dict[str, Any]:
        """Centre, components and basis."""
        return {
            "centre": self._centre.clone(),
            "components": self._components.clone(),
            "basis": None if self._basis is None else list(self._basis),
            "moved_in": self.moved_in,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self._centre = state["centre"].to(self.device)
        self._components = state["components"].to(self.device)
        basis = state["basis"]
        self._basis = None if basis is None else LatentBasis(*(b.to(self.device) for b in basis))
        self.moved_in = state["moved_in"]

    def _flat(self, frames: np.ndarray[Any, Any]) -> Float[Tensor, "n P"]:
        """Frames in a row, images in [0, 1]."""
        size = len(self._centre)
        flat = torch.from_numpy(np.ascontiguousarray(frames)).to(self.device).float()
        return flat.view(-1, size) / 255.0 if self._image else flat.view(-1, size)

    def _encoded(self, frames: np.ndarray[Any, Any]) -> Float[Tensor, "n d"]:
        """Latents of single frames (n, *frame)."""
        chunks = (frames[i : i + CHUNK] for i in range(0, len(frames), CHUNK))
        return torch.cat([self._latents(self._flat(chunk)) for chunk in chunks]).double()

    def _latents(self, flat: Float[Tensor, "n P"]) -> Float[Tensor, "n d"]:
        return (flat - self._centre) @ self._components

    def _frames_of(self, latents: Float[Tensor, "n d"]) -> Float[Tensor, "n P"]:
        return self._centre + latents @ self._components.T

    def _windows(self, episodes: Episodes) -> Float[Tensor, "N T1 W d"]:
        return windows_of(self.latents(episodes), self.task.observation.window)

    def _basis_of(self, episodes: Episodes) -> LatentBasis:
        """Whitening of entries that have been standardised: their units are their own."""
        windows = self._windows(episodes)[torch.from_numpy(episodes.live_frames).to(self.device)]
        if not self.settings.whitening:
            return LatentBasis.plain(windows)
        std = windows[:, 0].std(dim=0)
        std = torch.where(std > LEAST_STD, std, 1.0)
        A, b = LatentBasis.whitening(windows / std)
        return LatentBasis(A / std.repeat(windows.shape[1]), b)


def principal_components(
    frames: Float[Tensor, "n P"], count: int
) -> tuple[Float[Tensor, " P"], Float[Tensor, "P d"]]:
    """Mean and ``count`` orthonormal directions of largest variance, the largest first.

    By the inner products of frames, of which there are fewer than pixels. Directions that frames do
    not vary in are zero.
    """
    mean = frames.mean(dim=0)
    centred = frames - mean
    values, vectors = torch.linalg.eigh((centred @ centred.T).double())
    values, vectors = values.flip(0)[:count], vectors.flip(1)[:, :count]
    varied = values > LEAST_SHARE * values[0].clamp_min(1e-12)
    scaled = torch.where(varied, vectors / values.clamp_min(1e-12).sqrt(), 0.0)
    found = centred.T @ scaled.to(centred)
    return mean, torch.nn.functional.pad(found, (0, count - found.shape[1]))
