"""Planning by sampled action sequences: the cross-entropy method, and random shooting.

All episodes and all samples are one batch of one tensor program. Axes: N episodes, S samples,
H steps ahead, a entries of an action.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from jaxtyping import Float
from torch import Tensor


class Forecast(Protocol):
    """Predicted costs of action sequences, each episode's from where it stands."""

    def __call__(self, actions: Float[Tensor, "N S H a"]) -> Float[Tensor, "N S"]:
        """Sums over the H steps."""


class Draws(Protocol):
    """Random numbers of a plan."""

    def __call__(self, *shape: int) -> Tensor:
        """Standard normal, or uniform in [-1, 1], as the planner says."""


class Search(NamedTuple):
    """How far a plan looks, and how hard."""

    horizon: int
    samples: int
    iterations: int
    elites: int
    bound: float
    """of every entry of an action"""


def cross_entropy(
    forecast: Forecast,
    mean: Float[Tensor, "N H a"],
    std: Float[Tensor, "N H a"],
    search: Search,
    normal: Draws,
    *,
    smoothing: float = 0.0,
    least_std: float = 1e-3,
) -> Float[Tensor, "N H a"]:
    """The mean of the last elites (Rubinstein 1999; as Chua et al. 2018 and the authors' release).

    Each iteration draws ``samples`` sequences around the mean, truncated at two standard deviations
    and at the bound, and refits mean and deviation to the ``elites`` of least cost. ``smoothing``
    is the share of the old mean and deviation that stays.
    """
    count, horizon, size = mean.shape
    for _ in range(search.iterations):
        noise = normal(count, search.samples, horizon, size).clamp(-2.0, 2.0)
        actions = mean[:, None] + std[:, None] * noise
        actions = actions.clamp(-search.bound, search.bound)
        best = forecast(actions).topk(search.elites, dim=1, largest=False).indices
        elites = actions.take_along_dim(best[..., None, None], dim=1)
        mean = smoothing * mean + (1 - smoothing) * elites.mean(dim=1)
        spread = elites.std(dim=1, correction=0).clamp_min(least_std)
        std = smoothing * std + (1 - smoothing) * spread
    return mean


def random_shooting(
    forecast: Forecast, count: int, size: int, search: Search, uniform: Draws
) -> Float[Tensor, "N H a"]:
    """The best of uniformly drawn sequences (Nagabandi et al. 2018)."""
    actions = search.bound * uniform(count, search.samples, search.horizon, size)
    best = forecast(actions).argmin(dim=1)
    return actions[torch.arange(count), best]
