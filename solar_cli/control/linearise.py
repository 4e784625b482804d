"""LINEARIZEPOLICY (Appendix C): the old policy, seen through a recognition model that has changed.

Axes: N episodes, T horizon, d latent, a action. float64.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from solar_cli.control.linear_gaussian import LinearGaussianPolicy

# Ridges in units of each latent's variance at the time step. The least leaves an exactly affine
# change of the latents exact to some nine digits.
RIDGES = (1e-10, 1e-8, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
LEAST_STD = (
    1e-6  # of a latent's std over all time steps: below it, a time step's spread is rounding
)


class Linearisation(NamedTuple):
    """The policy in the new latents; ``residual`` and ``ridge`` are metrics.

    ``residual`` is the share of the old means' spread over episodes that the new policy misses on
    episodes left out of the fit: 0 is exact, 1 explains nothing.
    """

    policy: LinearGaussianPolicy
    residual: float
    ridge: float


class _RidgeFit(NamedTuple):
    """Slopes of one ridge, and the errors on each episode when it is left out."""

    K: Float[Tensor, "T a d"]
    left_out: Float[Tensor, "T N a"]


def linearise_policy(
    latents: Float[Tensor, "N T d"],
    action_means: Float[Tensor, "N T a"],
    live: Bool[Tensor, "N T"],
    previous: LinearGaussianPolicy,
) -> Linearisation:
    """The linear-Gaussian policy that acts on the new ``latents`` as the previous did on the old.

    ``action_means`` are the previous policy's noise-free actions in these episodes: regressing them
    and not the executed actions keeps the exploration noise out of the targets. At each time step
    slopes come from data centred there and offsets from the exact means. One ridge, chosen by the
    leave-one-out error of all time steps, bears the directions that N episodes do not show.
    The covariance is the previous one plus that of the leave-one-out errors. An affine change of
    the latents is recovered exactly when N > d + 1. At every time step at least two episodes must
    be ``live``; others do not count.
    """
    if (episodes := int(live.sum(dim=0).min())) < 2:
        raise ValueError(f"linearise_policy needs at least 2 episodes, got {episodes}")
    z, actions = latents.double().transpose(0, 1), action_means.double().transpose(0, 1)
    weight = live[..., None].to(z).transpose(0, 1)
    count = weight.sum(1, keepdim=True)
    z_mean, a_mean = ((part * weight).sum(1, keepdim=True) / count for part in (z, actions))
    z_centred, a_centred = (z - z_mean) * weight, (actions - a_mean) * weight
    fits = _ridge_fits(z_centred, a_centred, weight)
    errors = [float(fit.left_out.square().sum()) for fit in fits]
    chosen = min(range(len(fits)), key=errors.__getitem__)
    fit = fits[chosen]
    k = a_mean[:, 0] - (fit.K @ z_mean.mT)[..., 0]
    S = previous.S + fit.left_out.mT @ fit.left_out / count
    total = float(a_centred.square().sum())
    residual = (errors[chosen] / total) ** 0.5 if total > 0 else 0.0
    return Linearisation(LinearGaussianPolicy(fit.K, k, S), residual, RIDGES[chosen])


def _ridge_fits(
    z: Float[Tensor, "T N d"], actions: Float[Tensor, "T N a"], weight: Float[Tensor, "T N 1"]
) -> list[_RidgeFit]:
    """Ridge regressions of centred actions on centred latents, one for each of ``RIDGES``.

    Where ``weight`` is 0 and not 1 an episode does not count; its z and actions are zero there. One
    singular value decomposition serves them all. The error on an episode left out of the fit is its
    residual over 1 - h, h being its leverage, 1/N of which belongs to the mean.
    """
    count = weight.sum(1, keepdim=True)
    std = (z.square().sum(1, keepdim=True) / count).sqrt()
    least = LEAST_STD * (z.square().sum((0, 1)) / weight.sum()).sqrt()
    scale = torch.maximum(std, torch.where(least > 0, least, 1.0))
    U, s, Vh = torch.linalg.svd(z / scale, full_matrices=False)
    projected = U.mT @ actions
    fits = []
    for ridge in RIDGES:
        denominator = s.square() + count[..., 0] * ridge
        shrinkage = (s.square() / denominator)[..., None]
        coefficients = Vh.mT @ ((s / denominator)[..., None] * projected)
        leverage = (U.square() @ shrinkage) + weight / count
        residual = (actions - U @ (shrinkage * projected)) * weight
        fits.append(_RidgeFit((coefficients / scale.mT).mT, residual / (1 - leverage)))
    return fits
