"""The normal-inverse-Wishart (NIW) belief about the Gaussian of the initial latent state (Eq. 2-3).

    Sigma ~ IW(Psi, nu),   mu | Sigma ~ N(mu0, Sigma / kappa),   z_0 ~ N(mu, Sigma)

It is the MNIW of a regression on the constant 1 alone: M = mu0, V = 1/kappa. So its natural
parameters are the same ``RegressionStatistics`` with p = 1, and move by the same
``natural_gradient_step``.

Axes: N samples, d latent. Leading axes are batch axes; float64 throughout.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from solar_cli.inference import mniw
from solar_cli.inference.mniw import MNIW, RegressionStatistics
from solar_cli.inference.mniw import natural_gradient_step as natural_gradient_step


class NIW(NamedTuple):
    """Standard parameters; proper for nu > d - 1 and kappa > 0."""

    Psi: Float[Tensor, "*batch d d"]
    nu: Float[Tensor, "*batch"]
    mu0: Float[Tensor, "*batch d"]
    kappa: Float[Tensor, "*batch"]


def natural(q: NIW) -> RegressionStatistics:
    """Natural parameters (Psi + kappa mu0 mu0^T, kappa mu0, kappa, nu)."""
    return mniw.natural(_as_regression(q))


def standard(parameters: RegressionStatistics) -> NIW:
    """The belief with these natural parameters."""
    q = mniw.standard(parameters)
    return NIW(q.Psi, q.nu, q.M[..., 0], 1 / q.V[..., 0, 0])


def kl_divergence(q: NIW, p: NIW) -> Float[Tensor, "*batch"]:
    """KL(q || p) in nats."""
    return mniw.kl_divergence(_as_regression(q), _as_regression(p))


def initial_statistics(
    z_mean: Float[Tensor, "*batch N d"],
    z_variance: Float[Tensor, "*batch N d"] | None = None,
    weights: Float[Tensor, "*batch N"] | None = None,
) -> RegressionStatistics:
    """Expected sufficient statistics of N initial states under a mean-field q, summed over them."""
    ones = torch.ones_like(z_mean[..., :1])
    return mniw.regression_statistics(ones, z_mean, y_variance=z_variance, weights=weights)


def expected_initial_kl(
    parameters: RegressionStatistics,
    starts: RegressionStatistics,
    log_variance: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch"]:
    """Sum over starts of E_q(mu,Sigma) KL(N(z_mean, diag z_variance) || N(mu, Sigma)) in nats.

    The t = 0 term of the latent KL, which the paper's ELBO leaves out. ``parameters`` are natural
    ones; ``starts`` and ``log_variance`` are as `mniw.expected_transition_kl` has them.
    """
    expected = mniw.expected_statistics(parameters)
    return mniw.expected_transition_kl(expected, starts, log_variance)


def _as_regression(q: NIW) -> MNIW:
    return MNIW(q.Psi, q.nu, q.mu0[..., None], 1 / q.kappa[..., None, None])
