"""Episodes as control sees them: states of a representation, actions and costs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from solar_cli.episodes import Episodes

MOST_COMPARED = 40
"""time steps. With a quarter of the car's 100, held-out R2 of its dynamics was off by up to .16."""


def compared_steps(counts: Float[Tensor, " T"]) -> Int[Tensor, " compared"]:
    """Time steps that alternatives are compared at, given how many samples each step has.

    All that have any, or of many those that divide the samples evenly, with the first and the last:
    neighbouring steps say nearly the same, and a fit of each of them takes its time.
    """
    sampled, before = int((counts > 0).sum()), counts.cumsum(dim=0)
    if sampled <= MOST_COMPARED:
        return torch.arange(sampled)
    evenly = torch.linspace(1, float(before[-1]), MOST_COMPARED, dtype=torch.float64)
    steps: Tensor = torch.unique(torch.searchsorted(before.double(), evenly))
    return steps


class Transitions(NamedTuple):
    """Samples of each time step's dynamics; x and y are zero where an episode had ended."""

    x: Float[Tensor, "T N p"]
    """[z_t; a_t]"""
    y: Float[Tensor, "T N d"]
    """increments of the newest block of d entries"""
    live: Float[Tensor, "T N"]
    """1, or 0 where an episode had ended"""

    def of(self, episodes: Tensor) -> Transitions:
        """Those of some episodes."""
        return Transitions(*(part[:, episodes] for part in self))

    def at(self, times: Int[Tensor, " times"]) -> Transitions:
        """Those of some time steps; where no episode was running, of the last that one lived in."""
        steps = self.steps(times)
        return Transitions(*(part[steps] for part in self))

    def steps(self, times: Int[Tensor, " times"]) -> Int[Tensor, " times"]:
        """The time steps whose samples tell of ``times``."""
        return times.clamp(max=self.sampled - 1)

    @property
    def sampled(self) -> int:
        """Time steps that have samples: the first ones."""
        return int(self.live.any(dim=1).sum())

    @property
    def counts(self) -> Float[Tensor, " T"]:
        """Samples of each time step; 1, to divide by, where there is none."""
        return self.live.sum(dim=1).clamp_min(1.0)

    def means(self) -> tuple[Float[Tensor, "T 1 p"], Float[Tensor, "T 1 d"]]:
        """Of each time step."""
        counts = self.counts[:, None, None]
        return self.x.sum(dim=1, keepdim=True) / counts, self.y.sum(dim=1, keepdim=True) / counts


class Trajectories(NamedTuple):
    """One batch. Axes: N episodes, T horizon, z entries of a state, a of an action; float64."""

    z: Float[Tensor, "N T1 z"]
    actions: Float[Tensor, "N T a"]
    """as executed"""
    action_means: Float[Tensor, "N T a"]
    """without noise"""
    costs: Float[Tensor, "N T"]
    live: Bool[Tensor, "N T"]
    """whether an episode was still running: other steps are not learned from"""

    @property
    def planned(self) -> int:
        """Time steps that two episodes lived at least: what a fit has to go by."""
        return int((self.live.sum(dim=0) >= 2).sum())

    @property
    def reached(self) -> int:
        """Time steps that at least half of the episodes lived."""
        return int((2 * self.live.sum(dim=0) >= len(self.live)).sum())

    @property
    def noisy(self) -> Bool[Tensor, " N"]:
        """Episodes whose every action had noise; without it an action is its mean, or clipped."""
        return ((self.actions != self.action_means).any(dim=-1) | ~self.live).all(dim=1)

    def only(self, episodes: Bool[Tensor, " N"] | slice) -> Trajectories:
        """Some of the episodes."""
        return Trajectories(*(part[episodes] for part in self))

    def until(self, steps: int) -> Trajectories:
        """The first time steps."""
        first = (part[:, :steps] for part in self[1:])
        return Trajectories(self.z[:, : steps + 1], *first)

    @staticmethod
    def of(z: Float[Tensor, "N T1 z"], episodes: Episodes) -> Trajectories:
        """The states of ``episodes`` with what else control needs."""
        return Trajectories(
            z,
            torch.from_numpy(episodes.actions),
            torch.from_numpy(episodes.action_means),
            torch.from_numpy(episodes.costs),
            torch.from_numpy(episodes.live_steps),
        )

    @staticmethod
    def joined(parts: Sequence[Trajectories]) -> Trajectories:
        """All episodes of several batches, in order."""
        return Trajectories(*(torch.cat(part) for part in zip(*parts, strict=True)))

    def transitions(self, d: int) -> Transitions:
        """Regressors and increments of the newest block of d entries."""
        x = torch.cat([self.z[:, :-1], self.actions], dim=-1)
        y = self.z.diff(dim=1)[..., :d]
        over = ~self.live.unsqueeze(-1)
        parts = x.masked_fill_(over, 0.0), y.masked_fill_(over, 0.0), self.live.to(x)
        return Transitions(*(part.transpose(0, 1) for part in parts))
