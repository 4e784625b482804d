"""What a local method asks of whatever makes states of frames, learned or not."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from torch import Tensor

from solar_cli.episodes import Episodes
from solar_cli.experience import Experience
from solar_cli.models.basis import LatentBasis
from solar_cli.models.priors import LatentPrior


class StateRepresentation(Protocol):
    """Frames become latents of d entries, and windows of latents the states of control."""

    moved_in: int
    """the last iteration whose update changed what states mean; 0 before the first"""

    @property
    def trained(self) -> bool:
        """Whether there is something to embed with."""

    @property
    def basis(self) -> LatentBasis:
        """From windows of latents to states; fixed after the first update."""

    @property
    def latent(self) -> int:
        """d: latents of one time step."""

    @property
    def state_size(self) -> int:
        """z: entries of a state."""

    def update(self, experience: Experience) -> dict[str, float]:
        """MODELUPDATE (Algorithm 1, line 5); metrics of it."""

    def dynamics_prior(self, older: list[Episodes], *, as_it_stands: bool) -> LatentPrior:
        """What is known of dynamics, for INFERDYNAMICS, on the CPU."""

    def embed(self, episodes: Episodes) -> Float[Tensor, "N T1 z"]:
        """States of every step."""

    def latents(self, episodes: Episodes) -> Float[Tensor, "N T1 d"]:
        """Latents of every frame, from which states are made."""

    def follow(
        self,
        frames: np.ndarray[Any, Any],
        t: int,
        belief: Any,
        actions: Float[Tensor, "N a"] | None,
    ) -> tuple[Float[Tensor, "N d"], Any]:
        """Latents of the frames (N, *frame) of step ``t``, as ``latents`` gives them of all.

        The belief is what the step before returned, ``actions`` what was wanted then; both are None
        at the start.
        """

    def reconstruct(self, episodes: Episodes) -> np.ndarray[Any, Any]:
        """Frames as latents tell them, in the shape and units of ``episodes.frames``."""

    def state_dict(self) -> dict[str, Any]:
        """Plain data and tensors."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
