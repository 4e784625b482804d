"""The inverse-Wishart distribution of a covariance, shared by the MNIW and the NIW.

    IW(S | Psi, nu) = |S|^{-(nu+d+1)/2} exp(-1/2 tr(Psi S^-1)) / Z,    nu > d - 1

Axes: d rows of the covariance. Leading axes are batch axes and broadcast.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from solar_cli.inference import cholesky


def log_determinant(matrix: Float[Tensor, "*batch d d"]) -> Float[Tensor, "*batch"]:
    """log|A| of positive-definite matrices; raises ``torch.linalg.LinAlgError`` for others."""
    return cholesky.log_determinant(torch.linalg.cholesky(matrix))


def multivariate_digamma(x: Float[Tensor, "*batch"], d: int) -> Float[Tensor, "*batch"]:
    """The derivative of log Gamma_d at x: the sum of digamma(x - i/2) over i < d."""
    shifts = torch.arange(d, dtype=x.dtype, device=x.device) / 2
    return torch.digamma(x[..., None] - shifts).sum(-1)


def expected_log_det_precision(
    log_det_Psi: Float[Tensor, "*batch"], d: int, nu: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """E log|S^-1|."""
    return multivariate_digamma(nu / 2, d) - log_det_Psi + d * math.log(2)


def kl_divergence(
    Psi_q: Float[Tensor, "*batch d d"],
    nu_q: Float[Tensor, "*batch"],
    Psi_p: Float[Tensor, "*batch d d"],
    nu_p: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch"]:
    """KL(IW(Psi_q, nu_q) || IW(Psi_p, nu_p)) in nats."""
    d = Psi_q.shape[-1]
    trace: Tensor = torch.linalg.solve(Psi_q, Psi_p).diagonal(dim1=-2, dim2=-1).sum(-1)
    return (
        nu_p / 2 * (log_determinant(Psi_q) - log_determinant(Psi_p))
        + torch.mvlgamma(nu_p / 2, d)
        - torch.mvlgamma(nu_q / 2, d)
        + (nu_q - nu_p) / 2 * multivariate_digamma(nu_q / 2, d)
        + nu_q / 2 * (trace - d)
    )
