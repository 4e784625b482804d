"""Planning by sampled action sequences: the cross-entropy method, and random shooting.

All episodes and all samples are one batch of one tensor program. Every episode of a batch is tried
with the same draws, which makes its plan independent of the episodes beside it.

Axes: N episodes, S samples, H steps ahead, z entries of a state, a of an action.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

ROWS = 2048
"""states that are predicted at a time: more do not fit a cache, and are slower"""


class Forecast(Protocol):
    """Predicted costs of action sequences, each episode's from where it stands."""

    def __call__(self, actions: Float[Tensor, "N S H a"]) -> Float[Tensor, "N S"]:
        """Sums over the H steps."""


class RolledOut:
    """A `Forecast` by a model of dynamics and one of costs, one step after another.

    Counted are the costs of states that an action leads to: that of now is the same for all plans.
    Predictions that are not finite cost infinitely much.
    """

    def __init__(
        self,
        dynamics: Callable[[Tensor, Tensor], Tensor],
        cost: Callable[[Tensor, Tensor], Tensor],
        start: Float[Tensor, "N z"],
    ) -> None:
        self._dynamics, self._cost, self._start = dynamics, cost, start

    def __call__(self, actions: Float[Tensor, "N S H a"]) -> Float[Tensor, "N S"]:
        """As `Forecast`."""
        some = max(1, ROWS // actions.shape[1])
        parts = zip(torch.split(self._start, some), torch.split(actions, some), strict=True)
        return torch.cat([self._of(start, chosen) for start, chosen in parts])

    def _of(self, start: Tensor, actions: Tensor) -> Tensor:
        count, samples, horizon, size = actions.shape
        states = start.repeat_interleave(samples, dim=0)
        steps = actions.reshape(count * samples, horizon, size).unbind(dim=1)
        total = torch.zeros_like(states[:, 0])
        for step in steps:
            states = self._dynamics(states, step)
            total += self._cost(states, step)
        return total.view(count, samples).nan_to_num(torch.inf)


class Search(NamedTuple):
    """How hard the cross-entropy method looks, in units of actions."""

    iterations: int
    elites: int
    bound: float
    """of every entry of an action"""
    std: float
    """of every entry at first"""
    least_std: float


def cross_entropy(
    forecast: Forecast,
    mean: Float[Tensor, "N H a"],
    search: Search,
    normal: Callable[[int], Float[Tensor, "S H a"]],
) -> Float[Tensor, "N H a"]:
    """The mean of the last elites (Rubinstein 1999; as Chua et al. 2018 and the authors' release).

    Each iteration draws sequences around the mean, clipped at two standard deviations and at the
    bound, and refits mean and deviation to those of least cost. The mean itself is one of them.
    ``normal`` gives the draws of an iteration.
    """
    std = torch.full_like(mean, search.std)
    for iteration in range(search.iterations):
        noise = normal(iteration).clamp(-2.0, 2.0)
        noise[0] = 0.0
        actions = torch.addcmul(mean[:, None], std[:, None], noise)
        actions = actions.clamp_(-search.bound, search.bound)
        best = forecast(actions).topk(search.elites, dim=1, largest=False).indices
        elites = actions.take_along_dim(best[..., None, None], dim=1)
        mean = elites.mean(dim=1)
        std = elites.std(dim=1, correction=0).clamp_min(search.least_std)
    return mean


def random_shooting(
    forecast: Forecast, count: int, actions: Float[Tensor, "S H a"]
) -> Float[Tensor, "N H a"]:
    """The best of given sequences, for each of ``count`` episodes (Nagabandi et al. 2018)."""
    return actions[forecast(actions.expand(count, -1, -1, -1)).argmin(dim=1)]


def shifted(plan: Float[Tensor, "N H a"], last: Float[Tensor, " a"]) -> Float[Tensor, "N H a"]:
    """A plan one step later: what it had for the next steps, and ``last`` at its end."""
    return torch.cat([plan[:, 1:], last.expand(len(plan), 1, -1)], dim=1)
