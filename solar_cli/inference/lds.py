"""Linear-Gaussian chains z_0 -> ... -> z_n with inputs u_t: smoother, filter, normaliser; batched.

    log p(z) = log p(z_0) + sum_t log N(z_{t+1} | F x_t, S),    x_t = [z_t; u_t],   u_t = [a_t; 1]

F, S and the Gaussian of z_0 may be beliefs: expectations of log p under an MNIW and an NIW are what
the variational posterior of a structured VAE is made of (Johnson et al. 2016). Such a p is not
normalised, so that the information form is the natural one: log p is a quadratic form whose
precision is block-tridiagonal. Evidence about z_t, independent Gaussians, adds to its diagonal. One
block Cholesky factorisation gives all there is to know; everything is differentiable.

Axes: n transitions, d latent, m inputs, p = d + m. Leading axes are batch axes and broadcast;
float64. A precision that is not positive definite raises ``torch.linalg.LinAlgError``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from solar_cli.inference import cholesky
from solar_cli.inference.mniw import ExpectedStatistics

LOG_2_PI = math.log(2 * math.pi)


class Evidence(NamedTuple):
    """exp(sum_i linear_i z_i - 1/2 precision_i z_i^2): a Gaussian of z_t, but for a factor."""

    precision: Float[Tensor, "*batch d"]
    linear: Float[Tensor, "*batch d"]

    @staticmethod
    def gaussian(mean: Float[Tensor, "*batch d"], variance: Float[Tensor, "*batch d"]) -> Evidence:
        """That of N(z | mean, diag variance)."""
        return Evidence(1 / variance, mean / variance)


class Chain(NamedTuple):
    """log of an unnormalised density: constant + sum_t linear_t^T z_t - 1/2 z^T Lambda z.

    ``diagonal`` are the diagonal blocks of Lambda, ``below`` the blocks (t+1, t).
    """

    diagonal: Float[Tensor, "*batch n1 d d"]
    below: Float[Tensor, "*batch n d d"]
    linear: Float[Tensor, "*batch n1 d"]
    constant: Float[Tensor, "*batch"]

    def given(self, evidence: Evidence) -> Chain:
        """Times the evidence about every z_t."""
        return self._replace(
            diagonal=self.diagonal + torch.diag_embed(evidence.precision),
            linear=self.linear + evidence.linear,
        )


class Smoothed(NamedTuple):
    """The normalised chain's marginals, and the logarithm of its normaliser."""

    mean: Float[Tensor, "*batch n1 d"]
    covariance: Float[Tensor, "*batch n1 d d"]
    cross: Float[Tensor, "*batch n d d"]
    """Cov(z_t, z_{t+1})"""
    log_normaliser: Float[Tensor, "*batch"]


class Belief(NamedTuple):
    """A Gaussian in information form."""

    precision: Float[Tensor, "*batch d d"]
    linear: Float[Tensor, "*batch d"]

    @property
    def mean(self) -> Float[Tensor, "*batch d"]:
        """Its mean."""
        factor = torch.linalg.cholesky(self.precision)
        return torch.cholesky_solve(self.linear.unsqueeze(-1), factor).squeeze(-1)

    def given(self, evidence: Evidence) -> Belief:
        """After seeing evidence."""
        return Belief(
            self.precision + torch.diag_embed(evidence.precision), self.linear + evidence.linear
        )


def known_dynamics(
    F: Float[Tensor, "*batch d p"], S: Float[Tensor, "*batch d d"]
) -> ExpectedStatistics:
    """What a belief that is certain of F and S expects."""
    precision = cholesky.inverse(S)
    product = precision @ F
    log_det = -cholesky.log_determinant(torch.linalg.cholesky(S))
    return ExpectedStatistics(precision, product, F.mT @ product, log_det)


def prior_chain(
    initial: ExpectedStatistics,
    dynamics: ExpectedStatistics,
    inputs: Float[Tensor, "*batch n m"],
    live: Bool[Tensor, "*batch n1"] | None = None,
) -> Chain:
    """E log p(z) of beliefs about z_0, a regression on the constant 1, and about (F, S).

    The statistics of ``dynamics`` are of one map for all transitions, or have an axis n before the
    last two. States that are not ``live``, the last ones, are independent standard normals: they
    add nothing to what is computed of the others.
    """
    n, d = inputs.shape[-2], initial.precision.shape[-1]
    batch = inputs.shape[:-2]
    blocks = (*batch, n, d, d)
    zz = dynamics.F_precision_F[..., :d, :d].expand(blocks)
    arriving = dynamics.precision.expand(blocks)
    below = -dynamics.precision_F[..., :d].expand(blocks)
    pushed = _times(dynamics.precision_F[..., d:], inputs)
    leaving = _times(dynamics.F_precision_F[..., :d, d:], inputs)
    uu = (_times(dynamics.F_precision_F[..., d:, d:], inputs) * inputs).sum(-1)
    constants = (dynamics.log_det_precision.expand(uu.shape) - uu - d * LOG_2_PI) / 2
    if live is not None:
        after = live[..., 1:, None].to(inputs)
        square = after[..., None]
        identity = torch.eye(d).to(inputs)
        arriving = torch.where(live[..., 1:, None, None], arriving, identity)
        zz, below = zz * square, below * square
        pushed, leaving = pushed * after, leaving * after
        constants = torch.where(live[..., 1:], constants, -d * LOG_2_PI / 2)
    first = initial.precision.expand(*batch, d, d).unsqueeze(-3)
    start = initial.precision_F[..., 0].expand(*batch, d).unsqueeze(-2)
    of_start = initial.log_det_precision - initial.F_precision_F[..., 0, 0] - d * LOG_2_PI
    return Chain(
        diagonal=torch.cat([first, arriving], dim=-3)
        + torch.cat([zz, torch.zeros_like(first)], dim=-3),
        below=below,
        linear=torch.cat([start, pushed], dim=-2)
        - torch.cat([leaving, torch.zeros_like(start)], dim=-2),
        constant=constants.sum(-1) + of_start / 2,
    )


def _times(matrix: Float[Tensor, "*batch r m"], inputs: Float[Tensor, "*batch n m"]) -> Tensor:
    """The product of each input with one matrix, or with its own."""
    return (matrix @ inputs.unsqueeze(-1)).squeeze(-1)


def smooth(chain: Chain) -> Smoothed:
    """Marginals and normaliser, by a block Cholesky factorisation forward and one pass back."""
    n, d = chain.below.shape[-3], chain.linear.shape[-1]
    factors, solved = [], []
    upper = torch.cat([chain.below.mT, torch.zeros_like(chain.diagonal[..., :1, :, :])], dim=-3)
    blocks = torch.cat([chain.diagonal, chain.linear.unsqueeze(-1)], dim=-1).unbind(-3)
    uppers = upper.unbind(-3)
    rest = blocks[0]  # of the diagonal block and of the linear term, what is before it eliminated
    for t in range(n + 1):
        factor = torch.linalg.cholesky(rest[..., :d])
        right = torch.cat([uppers[t], rest[..., d:]], dim=-1)
        solution = torch.linalg.solve_triangular(factor, right, upper=False)
        factors.append(factor)
        solved.append(solution)
        if t < n:
            rest = blocks[t + 1] - solution[..., :d].mT @ solution
    factor, solution = torch.stack(factors, dim=-3), torch.stack(solved, dim=-3)
    squares = solution[..., d].square().sum((-2, -1))
    log_det = cholesky.log_determinant(factor).sum(-1)
    log_normaliser = chain.constant + (squares - log_det + (n + 1) * d * LOG_2_PI) / 2
    # What each state is given the next one: S_t^-1 covariance, G_t z_{t+1} + s_t mean.
    whitening = cholesky.inverse_factor(factor)
    own = (whitening.mT @ whitening).unbind(-3)
    back = whitening.mT @ solution
    gains, offsets = -back[..., :-1, :, :d], back[..., d].unbind(-2)
    gain = gains.unbind(-3)
    mean, covariance = [offsets[n]], [own[n]]
    for t in range(n - 1, -1, -1):
        covariance.append(own[t] + gain[t] @ covariance[-1] @ gain[t].mT)
        mean.append(offsets[t] + (gain[t] @ mean[-1].unsqueeze(-1)).squeeze(-1))
    covariances = torch.stack(covariance[::-1], dim=-3)
    cross = gains @ covariances[..., 1:, :, :]
    return Smoothed(torch.stack(mean[::-1], dim=-2), covariances, cross, log_normaliser)


def initial_belief(initial: ExpectedStatistics) -> Belief:
    """Of z_0, before any evidence."""
    return Belief(initial.precision, initial.precision_F[..., 0])


def predicted(
    belief: Belief, dynamics: ExpectedStatistics, inputs: Float[Tensor, "*batch m"]
) -> Belief:
    """Of z_{t+1}, given that of z_t and the input u_t: one step of the filter."""
    d = belief.linear.shape[-1]
    zz, zu = dynamics.F_precision_F[..., :d, :d], dynamics.F_precision_F[..., :d, d:]
    linear = belief.linear - (zu @ inputs.unsqueeze(-1)).squeeze(-1)
    factor = torch.linalg.cholesky(belief.precision + zz)
    across = dynamics.precision_F[..., :d].mT.expand_as(factor)
    right = torch.cat([across, linear.unsqueeze(-1)], dim=-1)
    solution = torch.linalg.solve_triangular(factor, right, upper=False)
    gained = solution[..., :d].mT @ solution
    pushed = (dynamics.precision_F[..., d:] @ inputs.unsqueeze(-1)).squeeze(-1)
    return Belief(dynamics.precision - gained[..., :d], pushed + gained[..., d])
