"""Quadratics 1/2 z^T C z + c^T z + b of the least squared error, C >= 0.

A quadratic is linear in its weights w of monomials, and so that error is a quadratic in w, which
their second moments tell; of those that are convex the best is found by convex optimisation.

Axes: T horizon, N episodes, n samples of a fit, m features of z, q monomials of them. The leading
axes k are of fits that are made at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from solar_cli.inference import quadratics

PENALTY = 0.1  # of the search for C, in units of the mean square of a monomial of second degree
SGD_STEPS = 1000
SGD_RATE = 1e-2


class Moments(NamedTuple):
    """Sums over the samples of one or several fits: all that a squared error needs of them."""

    xx: Float[Tensor, "*k q q"]
    xy: Float[Tensor, "*k q"]
    yy: Float[Tensor, "*k"]
    n: Float[Tensor, "*k"]
    """samples"""

    @staticmethod
    def of(
        z: Float[Tensor, "N T m"], costs: Float[Tensor, "N T"], live: Bool[Tensor, "N T"]
    ) -> Moments:
        """Of every time step, over the episodes that were still running."""
        over = ~live.T
        x = quadratics.monomials(z.transpose(0, 1)).masked_fill(over.unsqueeze(-1), 0.0)
        y = costs.T.masked_fill(over, 0.0)
        xy = (x.mT @ y.unsqueeze(-1)).squeeze(-1)
        return Moments(x.mT @ x, xy, y.square().sum(dim=1), live.sum(dim=0).to(y))

    @staticmethod
    def weighted(
        x: Float[Tensor, "*k n q"], y: Float[Tensor, " n"], weight: Float[Tensor, "*k n"]
    ) -> Moments:
        """Of the same samples, which count for more or less than one."""
        heavy = x * weight.unsqueeze(-1)
        xy = (heavy.mT @ y.unsqueeze(-1)).squeeze(-1)
        return Moments(heavy.mT @ x, xy, (weight * y.square()).sum(dim=-1), weight.sum(dim=-1))

    @staticmethod
    def stacked(parts: Sequence[Moments]) -> Moments:
        """Of several fits, the new first axis."""
        return Moments(*map(torch.stack, zip(*parts, strict=True)))

    def error(self, w: Float[Tensor, "*k q"]) -> Float[Tensor, "*k"]:
        """Sum of squared errors of weights of monomials."""
        return _inner(w, _product(self.xx, w) - 2 * self.xy) + self.yy

    def surplus(self, w: Float[Tensor, "*k q"]) -> Float[Tensor, "*k"]:
        """Sum of the errors themselves."""
        return self.xy[..., -1] - _inner(self.xx[..., -1, :], w)

    def each(self, change: Callable[[Tensor], Tensor]) -> Moments:
        """The same done to all of them."""
        return Moments(*(change(part) for part in self))

    def together(self) -> Moments:
        """Of the samples of all fits of the first axis: time steps, or folds."""
        return self.each(lambda part: part.sum(dim=0))

    def plus(self, other: Moments) -> Moments:
        """Of the samples of both."""
        return Moments(*(a + b for a, b in zip(self, other, strict=True)))

    def minus(self, other: Moments) -> Moments:
        """Without the samples of the other."""
        return Moments(*(a - b for a, b in zip(self, other, strict=True)))

    def mean(self) -> Moments:
        """Means over samples; zero where there are none."""
        n = self.n.clamp_min(1e-9)
        return Moments(self.xx / n[..., None, None], self.xy / n[..., None], self.yy / n, self.n)


def least_squares(
    mean: Moments,
    penalty: Float[Tensor, "*#k q"],
    towards: Float[Tensor, "*#k q"],
    rounds: int,
) -> Float[Tensor, "*k q"]:
    """Weights w of the least mean squared error + penalty (w - towards)^2 with C >= 0.

    Without that condition it is a linear system. What is negative of its C is cut off, and
    ``rounds`` of the alternating direction method of multipliers (Boyd et al. 2011, section 5) find
    what else of C should change then: 30 bring the objective within 2 % of the least one
    (`test_convex_quadratic`). c and b are the best ones for the C that is found.

    Raises ``torch.linalg.LinAlgError`` where moments are not finite, or where they do not tell all
    coefficients and ``penalty`` is zero.
    """
    A, b = mean.xx + torch.diag_embed(penalty), mean.xy + penalty * towards
    q = b.shape[-1]
    second = q - quadratics.features(q) - 1
    scale = torch.diagonal(A, dim1=-2, dim2=-1)[..., :second].mean(dim=-1, keepdim=True)
    # |C|^2 = 2 |w|^2 in these weights.
    coupling = 2 * PENALTY * scale * quadratics.squares(q).to(b)
    coupling[..., second:] = 0
    C = quadratics.curvature(_divided(b, torch.linalg.cholesky(A)))
    split, dual = _nonnegative(C), torch.zeros_like(C)
    if rounds:
        factor = torch.linalg.cholesky(A + torch.diag_embed(coupling))
    for _ in range(rounds):
        dual = dual + C - split
        wanted = quadratics.weights(split - dual, torch.zeros_like(b[..., second:]))
        C = quadratics.curvature(_divided(b + coupling * wanted, factor))
        split = _nonnegative(C + dual)
    curved = quadratics.weights(split, b[..., :0])
    left = b[..., second:] - _product(A[..., second:, :second], curved)
    rest = _divided(left, torch.linalg.cholesky(A[..., second:, second:]))
    return torch.cat([curved, rest], dim=-1)


def descended(mean: Moments, penalty: Float[Tensor, "*#k q"]) -> Float[Tensor, "*k q"]:
    """The same towards zero, by gradients through C = L L^T, as section 3 parametrises it.

    L has a positive diagonal.
    """
    m = quadratics.features(mean.xy.shape[-1])
    L = -torch.eye(m).to(mean.xy).repeat(*mean.n.shape, 1, 1)
    rest = mean.xy.new_zeros(*mean.n.shape, m + 1)
    parameters = [L.requires_grad_(), rest.requires_grad_()]
    optimiser = torch.optim.SGD(parameters, SGD_RATE, momentum=0.9)

    def weights() -> Tensor:
        diagonal = torch.nn.functional.softplus(torch.diagonal(L, dim1=-2, dim2=-1))
        cholesky = L.tril(-1) + torch.diag_embed(diagonal)
        return quadratics.weights(cholesky @ cholesky.mT, rest)

    for _ in range(SGD_STEPS):
        w = weights()
        loss = (mean.error(w) + _inner(penalty, w.square())).sum()
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
    with torch.no_grad():
        return weights()


def _divided(b: Float[Tensor, "*k q"], factor: Float[Tensor, "*k q q"]) -> Float[Tensor, "*k q"]:
    """A^-1 b, given the Cholesky factor of A."""
    return torch.cholesky_solve(b.unsqueeze(-1), factor).squeeze(-1)


def _nonnegative(C: Float[Tensor, "*k m m"]) -> Float[Tensor, "*k m m"]:
    """The nearest matrix without negative eigenvalues."""
    values, vectors = torch.linalg.eigh(C)
    nearest: Tensor = (vectors * values.clamp_min(0.0).unsqueeze(-2)) @ vectors.mT
    return nearest


def _product(A: Float[Tensor, "*k i j"], x: Float[Tensor, "*k j"]) -> Float[Tensor, "*k i"]:
    return (A @ x.unsqueeze(-1)).squeeze(-1)


def _inner(x: Float[Tensor, "*k q"], y: Float[Tensor, "*k q"]) -> Float[Tensor, "*k"]:
    product: Tensor = (x * y).sum(dim=-1)
    return product
