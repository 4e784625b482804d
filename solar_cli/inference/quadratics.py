"""Quadratics 1/2 z^T C z + c^T z + b as weights w of monomials, in which they are linear.

Axes: n points, m features of z, q = m (m + 1) / 2 + m + 1 monomials of them. The leading axes k
are of batches.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def monomials(z: Float[Tensor, "*k n m"]) -> Float[Tensor, "*k n q"]:
    """[z_i z_j for j <= i; z; 1]: a quadratic is linear in them."""
    i, j = torch.tril_indices(z.shape[-1], z.shape[-1])
    return torch.cat([z[..., i] * z[..., j], z, torch.ones_like(z[..., :1])], dim=-1)


def features(q: int) -> int:
    """m, of q = m (m + 1) / 2 + m + 1 monomials."""
    m: int = round((2 * q + 0.25) ** 0.5 - 1.5)
    return m


def curvature(w: Float[Tensor, "*k q"]) -> Float[Tensor, "*k m m"]:
    """C of weights of monomials."""
    m = features(w.shape[-1])
    i, j = torch.tril_indices(m, m)
    half = w.new_zeros(*w.shape[:-1], m, m)
    half[..., i, j] = w[..., : len(i)]
    return half + half.mT


def outer(sums: Float[Tensor, "*k q"]) -> Float[Tensor, "*k m m"]:
    """The sum of z z^T, of summed monomials."""
    doubled = curvature(sums)
    return doubled - torch.diag_embed(0.5 * doubled.diagonal(dim1=-2, dim2=-1))


def weights(C: Float[Tensor, "*k m m"], rest: Float[Tensor, "*k m1"]) -> Float[Tensor, "*k q"]:
    """Weights of `monomials`, of which ``rest`` are the last ones, [c; b]."""
    i, j = torch.tril_indices(*C.shape[-2:])
    halves = torch.where(i == j, 0.5, 1.0).to(C)
    return torch.cat([halves * C[..., i, j], rest], dim=-1)


def substituted(
    w: Float[Tensor, "*k q"], A: Float[Tensor, "*k m m"], s: Float[Tensor, "*k m"]
) -> Float[Tensor, "*k q"]:
    """Weights in u of a quadratic in z = A u + s."""
    m = s.shape[-1]
    C, c, b = curvature(w), w[..., -m - 1 : -1], w[..., -1:]
    curved = (C @ s[..., None])[..., 0]
    slope = (A.mT @ (curved + c)[..., None])[..., 0]
    height = b + ((c + 0.5 * curved) * s).sum(dim=-1, keepdim=True)
    return weights(A.mT @ C @ A, torch.cat([slope, height], dim=-1))


def squares(q: int) -> Float[Tensor, " q"]:
    """What each w_q^2 is multiplied by in |C|^2 / 2 + |c|^2, a sum of squared coefficients."""
    m = features(q)
    i, j = torch.tril_indices(m, m)
    return torch.cat([torch.where(i == j, 2.0, 1.0), torch.ones(m), torch.zeros(1)])
