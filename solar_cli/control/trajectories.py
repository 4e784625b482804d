"""Episodes as control sees them: states of a representation, actions and costs."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from solar_cli.episodes import Episodes


class Trajectories(NamedTuple):
    """One batch. Axes: N episodes, T horizon, z entries of a state, a of an action; float64."""

    z: Float[Tensor, "N T1 z"]
    actions: Float[Tensor, "N T a"]
    """as executed"""
    action_means: Float[Tensor, "N T a"]
    """without noise"""
    costs: Float[Tensor, "N T"]

    @staticmethod
    def of(z: Float[Tensor, "N T1 z"], episodes: Episodes) -> Trajectories:
        """The states of ``episodes`` with what else control needs."""
        return Trajectories(
            z,
            torch.from_numpy(episodes.actions),
            torch.from_numpy(episodes.action_means),
            torch.from_numpy(episodes.costs),
        )

    def increments(self, d: int) -> tuple[Float[Tensor, "T N p"], Float[Tensor, "T N d"]]:
        """Regressors x_t = [z_t; a_t] and increments of the newest block of d entries."""
        x = torch.cat([self.z[:, :-1], self.actions], dim=-1)
        return x.transpose(0, 1), self.z.diff(dim=1)[..., :d].transpose(0, 1)
