"""Maximum-entropy LQR, and its update under a bound on the KL divergence (4.2, Appendix A).

The update minimises the expected cost subject to sum_t KL(new || old) <= max_kl. Its Lagrangian is
a maximum-entropy LQR problem with the augmented cost  cost / eta - log old(a | z),  eta >= 0 being
the dual variable (the paper's lambda, which is also its name for natural parameters). The KL of
the solution falls as eta grows, so the bound is met by search over eta: a whole grid of eta goes
through one batched backward and forward pass, and the next grid lies inside the bracket found.

Misprints of the paper that matter here: the policy's covariance is +Q_aa^-1, and Q needs V_ss f
where the dynamics have an offset f.

Axes: G values of eta, T horizon, d latent, a action, p = d + a. float64.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from solar_cli.control.linear_gaussian import (
    LinearDynamics,
    LinearGaussianPolicy,
    QuadraticCost,
    bounded,
    expected_cost,
    kl_divergence,
    marginals,
)

# eta in units of the cost's spread under the old policy, where a step is about a nat. Below the
# bracket Q_aa loses its digits, above it the policy does not move.
BELOW, ABOVE = 1e-10, 1e8
NEXT_GRID, MOST_REFINEMENTS = 10, 3  # the first grid has one eta a decade
TOLERANCE = 0.03  # share of the bound that may stay unused


class Outcome(StrEnum):
    """How the search over eta ended, and what the returned policy is."""

    CONVERGED = "converged: the KL bound is used up"
    UNCONSTRAINED = "unconstrained: the best policy is within the KL bound"
    CURVATURE_LIMITED = (
        "curvature limited: Q_aa of any larger step is not positive definite; this is the largest"
    )
    BRACKET_EXHAUSTED = (
        "bracket exhausted: no eta uses the KL bound up; the step is smaller than allowed, or none"
    )
    NOT_POSITIVE_DEFINITE = (
        "not positive definite: Q_aa is indefinite or not finite for every eta; the policy is kept"
    )


class LQRSolution(NamedTuple):
    """A policy, and whether every Q_aa was positive definite; if not, the policy is meaningless."""

    policy: LinearGaussianPolicy
    definite: Bool[Tensor, "*batch"]


class PolicyUpdate(NamedTuple):
    """The result of ``improve_policy``; KL in nats and costs are sums over the trajectory."""

    policy: LinearGaussianPolicy
    kl: float
    eta: float
    predicted_before: float
    predicted_after: float
    outcome: Outcome


class _Candidates(NamedTuple):
    """Solutions for an ascending grid of eta, and which of them may be used."""

    eta: Float[Tensor, " G"]
    policy: LinearGaussianPolicy
    kl: Float[Tensor, " G"]
    definite: Bool[Tensor, " G"]


class _Found(NamedTuple):
    """The largest step found within the bound."""

    policy: LinearGaussianPolicy
    eta: float
    kl: float
    outcome: Outcome


def lqr_backward(dynamics: LinearDynamics, cost: QuadraticCost) -> LQRSolution:
    """The maximum-entropy policy a ~ N(K z + k, Q_aa^-1) of section 2.1.

    ``C`` and ``c`` of the cost may have leading batch axes. A member whose Q_aa is not positive
    definite at some time step is marked, never an error.
    """
    d = dynamics.mu0.shape[-1]
    V, v = cost.C[..., -1, :d, :d], cost.c[..., -1, :d]
    K, k, S = [], [], []
    definite = torch.ones(V.shape[:-2], dtype=torch.bool, device=V.device)
    stages = zip(
        dynamics.F.unbind(-3),
        dynamics.f.unbind(-2),
        cost.C[..., :-1, :, :].unbind(-3),
        cost.c[..., :-1, :].unbind(-2),
        strict=True,
    )
    for F, f, C, c in reversed(list(stages)):
        Q = C + F.mT @ (V @ F)
        q = c + (v + (V @ f[:, None])[..., 0]) @ F
        factor, failure = torch.linalg.cholesky_ex(Q[..., d:, d:])
        definite = definite & (failure == 0)
        # Q_za Q_aa^-1 Q_az = W^T W with W = L^-1 Q_az, which no rounding makes indefinite.
        right = torch.cat([Q[..., d:, :d], q[..., d:, None]], -1)
        W = torch.linalg.solve_triangular(factor, right, upper=False)
        gains = -torch.linalg.solve_triangular(factor.mT, W, upper=True)
        K.append(gains[..., :d])
        k.append(gains[..., d])
        S.append(torch.cholesky_inverse(factor))
        W_z = W[..., :d].mT
        V = Q[..., :d, :d] - W_z @ W_z.mT
        V = (V + V.mT) / 2
        v = q[..., :d] - (W_z @ W[..., d:])[..., 0]
    policy = LinearGaussianPolicy(
        torch.stack(K[::-1], -3), torch.stack(k[::-1], -2), torch.stack(S[::-1], -3)
    )
    return LQRSolution(policy, definite)


def improve_policy(
    previous: LinearGaussianPolicy,
    dynamics: LinearDynamics,
    cost: QuadraticCost,
    max_kl: float | None,
    std_bounds: tuple[float, float] | None = None,
) -> PolicyUpdate:
    """POLICYUPDATE of Algorithm 1: the policy of least expected cost within ``max_kl`` total nats.

    ``std_bounds`` (floor, ceiling) hold for the principal standard deviations of the new policy's
    noise. They are part of the optimisation: no nat is spent on noise that they would undo. For
    each eta, clipping the eigenvalues of Q_aa^-1 is the exact solution under them.

    Without a bound (``None`` or infinity) the result is ``lqr_backward``'s policy, eta being 0. The
    KL bound is used up to 3 % unless ``outcome`` says otherwise. When no step is possible the
    previous policy comes back (within ``std_bounds``). Its noise must be positive definite.
    """
    if max_kl is None or math.isinf(max_kl):
        found = _unbounded(previous, dynamics, cost, std_bounds)
    else:
        found = _search(previous, dynamics, cost, max_kl, std_bounds)
    before = float(expected_cost(previous, dynamics, cost).sum())
    after = float(expected_cost(found.policy, dynamics, cost).sum())
    return PolicyUpdate(found.policy, found.kl, found.eta, before, after, found.outcome)


def _unbounded(
    previous: LinearGaussianPolicy,
    dynamics: LinearDynamics,
    cost: QuadraticCost,
    std_bounds: tuple[float, float] | None,
) -> _Found:
    policy, definite = lqr_backward(dynamics, cost)
    if not definite:
        return _kept(previous, dynamics, std_bounds, Outcome.NOT_POSITIVE_DEFINITE)
    policy = _within(policy, std_bounds)
    kl = float(kl_divergence(policy, previous, dynamics).sum())
    return _Found(policy, 0.0, kl, Outcome.UNCONSTRAINED)


def _search(
    previous: LinearGaussianPolicy,
    dynamics: LinearDynamics,
    cost: QuadraticCost,
    max_kl: float,
    std_bounds: tuple[float, float] | None,
) -> _Found:
    """The smallest eta whose policy keeps the bound, by grids inside a shrinking bracket."""
    low, high = _bracket(previous, dynamics, cost)
    grid = _log_grid(low, high, math.ceil(math.log10(high / low)) + 1, previous.K)
    trial = _candidates(grid, previous, dynamics, cost, std_bounds)
    first = _first_allowed(trial, max_kl)
    if first == len(grid):
        definite = bool(trial.definite[-1])
        why = Outcome.BRACKET_EXHAUSTED if definite else Outcome.NOT_POSITIVE_DEFINITE
        return _kept(previous, dynamics, std_bounds, why)
    best = _member(trial, first)
    if first == 0:
        return best._replace(outcome=Outcome.UNCONSTRAINED)
    for _ in range(MOST_REFINEMENTS):
        if best.kl >= (1 - TOLERANCE) * max_kl:
            return best
        if first > 0:
            low, low_definite = float(grid[first - 1]), bool(trial.definite[first - 1])
        grid = _log_grid(low, best.eta, NEXT_GRID + 2, previous.K)[1:-1]
        trial = _candidates(grid, previous, dynamics, cost, std_bounds)
        first = _first_allowed(trial, max_kl)
        if first < len(grid):
            best = _member(trial, first)
    if best.kl >= (1 - TOLERANCE) * max_kl:
        return best
    why = Outcome.BRACKET_EXHAUSTED if low_definite else Outcome.CURVATURE_LIMITED
    return best._replace(outcome=why)


def _bracket(
    policy: LinearGaussianPolicy, dynamics: LinearDynamics, cost: QuadraticCost
) -> tuple[float, float]:
    """Where to look for eta, in units of how much a trajectory's cost varies under the policy.

    These are units of cost, whatever those of latents and actions. The low end is set by a typical
    time step (the geometric mean), the high end by the sum: under a locally unstable model, whose
    marginals explode with t, they lie far apart.
    """
    mean, covariance = marginals(policy, dynamics)
    std = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    slope = ((cost.C @ mean[..., None])[..., 0] + cost.c).abs()
    curvature = (std[..., None, :] @ cost.C.abs() @ std[..., None])[..., 0, 0]
    spread = (slope * std).sum(-1) + curvature / 2
    spread = spread[(spread > 0) & spread.isfinite()]
    if len(spread) == 0:
        return BELOW, ABOVE
    return float(len(spread) * spread.log().mean().exp()) * BELOW, float(spread.sum()) * ABOVE


def _candidates(
    eta: Float[Tensor, " G"],
    previous: LinearGaussianPolicy,
    dynamics: LinearDynamics,
    cost: QuadraticCost,
    std_bounds: tuple[float, float] | None,
) -> _Candidates:
    """The solutions of the augmented problems of all eta at once."""
    (K, k, S), definite = lqr_backward(*_augmented(previous, dynamics, cost, eta))
    # A useless member must not stop the eigenvalue routine for the others.
    usable = definite[:, None, None, None] & S.isfinite().all(-1).all(-1)[..., None, None]
    S = torch.where(usable, S, previous.S)
    policy = _within(LinearGaussianPolicy(previous.K + K, previous.k + k, S), std_bounds)
    kl = kl_divergence(policy, previous, dynamics).sum(-1)
    return _Candidates(eta, policy, kl, definite & kl.isfinite())


def _augmented(
    previous: LinearGaussianPolicy,
    dynamics: LinearDynamics,
    cost: QuadraticCost,
    eta: Float[Tensor, " G"],
) -> tuple[LinearDynamics, QuadraticCost]:
    """The problem with cost / eta - log previous(a | z), in deviations from the previous policy.

    With u = a - K z - k the second term is 1/2 u^T S^-1 u: it adds nothing to the value of a state.
    Written out in a and z, its parts cancel there, and a model whose states grow with t blows
    their rounding errors up.
    """
    (T, a, d), pad = previous.K.shape, torch.nn.functional.pad
    precision = torch.cholesky_inverse(torch.linalg.cholesky(previous.S))
    # x = change [z; u] + offset; at the horizon no action is taken.
    change = torch.eye(d + a, dtype=precision.dtype, device=precision.device).repeat(T + 1, 1, 1)
    change[:T, d:, :d] = previous.K
    offset = pad(previous.k, (d, 0, 0, 1))
    around = dynamics._replace(
        F=dynamics.F @ change[:T], f=dynamics.f + (dynamics.F @ offset[:T, :, None])[..., 0]
    )
    C = change.mT @ cost.C @ change
    gradient = cost.c + (cost.C @ offset[..., None])[..., 0]
    c = (change.mT @ gradient[..., None])[..., 0]
    divergence = pad(precision, (d, 0, d, 0, 0, 1))
    augmented = cost._replace(C=C / eta[:, None, None, None] + divergence, c=c / eta[:, None, None])
    return around, augmented


def _kept(
    previous: LinearGaussianPolicy,
    dynamics: LinearDynamics,
    std_bounds: tuple[float, float] | None,
    why: Outcome,
) -> _Found:
    """No step is possible."""
    policy = _within(previous, std_bounds)
    kl = float(kl_divergence(policy, previous, dynamics).sum())
    return _Found(policy, math.inf, kl, why)


def _within(
    policy: LinearGaussianPolicy, std_bounds: tuple[float, float] | None
) -> LinearGaussianPolicy:
    return policy if std_bounds is None else bounded(policy, *std_bounds)


def _first_allowed(trial: _Candidates, max_kl: float) -> int:
    """The start of the run of usable members that ends the grid; its length when there is none."""
    forbidden = torch.nonzero(~(trial.definite & (trial.kl <= max_kl)))
    return int(forbidden[-1]) + 1 if len(forbidden) else 0


def _member(trial: _Candidates, index: int) -> _Found:
    policy = LinearGaussianPolicy(*(part[index] for part in trial.policy))
    return _Found(policy, float(trial.eta[index]), float(trial.kl[index]), Outcome.CONVERGED)


def _log_grid(low: float, high: float, count: int, like: Tensor) -> Float[Tensor, " G"]:
    return torch.logspace(
        math.log10(low), math.log10(high), count, dtype=like.dtype, device=like.device
    )
