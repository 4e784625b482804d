"""Determinants and inverses of positive-definite matrices through their Cholesky factors A = L L^T.

Leading axes are batch axes.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def log_determinant(factor: Float[Tensor, "*batch d d"]) -> Float[Tensor, "*batch"]:
    """log|A| from its factor."""
    return factor.diagonal(dim1=-2, dim2=-1).log().sum(-1).mul(2)


def inverse_factor(factor: Float[Tensor, "*batch d d"]) -> Float[Tensor, "*batch d d"]:
    """L^-1: it whitens, as |L^-1 x|^2 = x^T A^-1 x."""
    identity = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    whitening: Tensor = torch.linalg.solve_triangular(
        factor, identity.expand_as(factor), upper=False
    )
    return whitening


def inverse(matrix: Float[Tensor, "*batch d d"]) -> Float[Tensor, "*batch d d"]:
    """A^-1; raises ``torch.linalg.LinAlgError`` where A is not positive definite."""
    whitening = inverse_factor(torch.linalg.cholesky(matrix))
    return whitening.mT @ whitening
