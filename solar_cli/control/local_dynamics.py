"""INFERDYNAMICS: time-varying linear-Gaussian dynamics around the newest episodes.

Section 4.1 and appendix B: an MNIW prior per time step, conditioned on the episodes. Only the
increment of the newest latent block is inferred; the other rows of F are what shifting does. Slopes
are pooled from data that is centred per time step; offsets come from each step's exact means.

Axes: N episodes, T horizon, d latents of a block, z = W d entries, x = [z; a] with p entries.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import product
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from solar_cli.control.linear_gaussian import LinearDynamics
from solar_cli.control.trajectories import Trajectories
from solar_cli.inference import gmm, mniw, niw
from solar_cli.models.basis import LatentPrior
from solar_cli.settings.local import LocalFit
from solar_cli.streams import Streams

ACTION_RIDGE = 1e-4  # noise of an action, in units of its std, that slopes must bear
LEAST_VARIANCE = 1e-9  # of a whitened latent: keeps Sigma invertible


class Strengths(NamedTuple):
    """Where the prior of a time step comes from."""

    model: float
    """pseudo-counts of the model's factor"""
    width: float
    """reach of neighbouring time steps, in steps"""
    neighbours: float
    """weight of a neighbour's sample, before its distance counts"""
    older: float
    """pseudo-counts of older batches"""


class Increments(NamedTuple):
    """p(u_{t+1} - u_t | x_t) = N(F x_t + f, Sigma)."""

    F: Float[Tensor, "T d p"]
    f: Float[Tensor, "T d"]
    Sigma: Float[Tensor, "T d d"]


class LocalDynamics(NamedTuple):
    """The fit, and metrics of what chose it."""

    model: LinearDynamics
    metrics: dict[str, float]


def infer_dynamics(
    newest: Trajectories,
    older: Sequence[Trajectories],
    prior: LatentPrior,
    settings: LocalFit,
    streams: Streams,
) -> LocalDynamics:
    """Local dynamics around the newest batch, given older ones and the representation's factor."""
    x, y = newest.increments(prior.latent)
    metrics: dict[str, float] = {}
    if settings.method == "posterior":
        sources = _sources(newest, older, prior, settings)
        strengths, likelihood, r2 = _chosen(x, y, sources, settings)
        increments = _posterior(x, y, sources, strengths)
        metrics = {"one_step_log_likelihood": likelihood, "one_step_r2": r2}
        metrics |= {f"prior_{name}": value for name, value in strengths._asdict().items()}
    elif settings.method == "regression":
        increments = _regression(x, y)
    else:
        increments = _mixture_prior(x, y, streams)
    return LocalDynamics(_whole(increments, newest, prior), metrics)


class _Sources(NamedTuple):
    """Centred statistics that a prior can be made of, one pseudo-count each."""

    ridge: mniw.RegressionStatistics
    model: mniw.RegressionStatistics | None
    older: mniw.RegressionStatistics | None


def _sources(
    newest: Trajectories, older: Sequence[Trajectories], prior: LatentPrior, settings: LocalFit
) -> _Sources:
    d, actions = prior.latent, newest.actions.shape[-1]
    x, y = newest.increments(d)
    spread = (x - x.mean(dim=1, keepdim=True)).square().mean(dim=(0, 1)).sqrt()
    ridge = torch.full_like(spread, settings.ridge)  # whitened latents have unit scale
    ridge[-actions:] = ACTION_RIDGE * spread[-actions:].clamp_min(1e-6)
    degrees = y.new_tensor(d + 2.0)
    weak = mniw.RegressionStatistics(
        degrees * settings.ridge**2 * torch.eye(d).to(y),
        y.new_zeros(d, len(spread)),
        torch.diag(x.shape[1] * ridge.square()),
        degrees,
    )
    model = None if prior.factor is None else _per_count(_in_basis(prior, actions))
    past = [_centred_statistics(*batch.increments(d)) for batch in older]
    joined = reduce(mniw.RegressionStatistics.plus, past) if past else None
    return _Sources(weak, model, None if joined is None else _per_count(joined))


def _in_basis(prior: LatentPrior, actions: int) -> mniw.RegressionStatistics:
    """The factor's statistics for increments of whitened latents, centred."""
    factor, d = prior.factor, prior.latent
    assert factor is not None
    # A factor over all of z_{t+1} has the newest block in its first rows.
    yy, yx = factor.yy[..., :d, :d], factor.yx[..., :d, :]
    joint = torch.cat([torch.cat([yy, yx], dim=-1), torch.cat([yx.mT, factor.xx], dim=-1)], dim=-2)
    R = prior.basis.change_of_variables(d, actions)
    joint = R @ joint @ R.T
    changed = mniw.RegressionStatistics(
        joint[..., :d, :d], joint[..., :d, d:], joint[..., d:, d:], factor.n
    )
    return mniw.centred(changed, changed.xx.shape[-1] - 1)


def _per_count(statistics: mniw.RegressionStatistics) -> mniw.RegressionStatistics:
    return statistics.scaled(1 / statistics.n.clamp_min(1.0))


def _centred_statistics(
    x: Float[Tensor, "T N p"], y: Float[Tensor, "T N d"]
) -> mniw.RegressionStatistics:
    return mniw.regression_statistics(
        x - x.mean(dim=-2, keepdim=True), y - y.mean(dim=-2, keepdim=True)
    )


def _neighbourhood(horizon: int, strengths: Strengths) -> Float[Tensor, "T T"]:
    """Weight of step s's samples in the fit at t: 1 for its own, less for its neighbours."""
    times = torch.arange(horizon, dtype=torch.float64)
    distance = times[:, None] - times
    weight = strengths.neighbours * torch.exp(-0.5 * (distance / strengths.width).square())
    weight.fill_diagonal_(1.0)
    return weight


def _pooled(own: mniw.RegressionStatistics, weight: Tensor) -> mniw.RegressionStatistics:
    weight = weight.to(own.yy)
    return mniw.RegressionStatistics(*(torch.einsum("ts,s...->t...", weight, part) for part in own))


def _natural(
    own: mniw.RegressionStatistics, sources: _Sources, strengths: Strengths
) -> mniw.RegressionStatistics:
    """Prior and data of every time step: appendix B is a sum in natural parameters."""
    total = _pooled(own, _neighbourhood(len(own.n), strengths))
    total = mniw.RegressionStatistics(*(t + r for t, r in zip(total, sources.ridge, strict=True)))
    for source, counts in ((sources.model, strengths.model), (sources.older, strengths.older)):
        if source is not None and counts:
            total = mniw.RegressionStatistics(
                *(t + counts * s for t, s in zip(total, source, strict=True))
            )
    return total


def _posterior(
    x: Float[Tensor, "T N p"], y: Float[Tensor, "T N d"], sources: _Sources, strengths: Strengths
) -> Increments:
    natural = _natural(_centred_statistics(x, y), sources, strengths)
    F, Sigma = mniw.point_estimate(mniw.standard(natural))
    f = y.mean(dim=1) - (F @ x.mean(dim=1).unsqueeze(-1)).squeeze(-1)
    return Increments(F, f, Sigma + LEAST_VARIANCE * torch.eye(y.shape[-1]).to(y))


def _grid(sources: _Sources, settings: LocalFit) -> list[Strengths]:
    """All combinations that differ: no reach without neighbours, no counts without a source."""
    grid = product(
        settings.prior_counts if sources.model is not None else (0.0,),
        settings.widths,
        settings.neighbours,
        settings.older_counts if sources.older is not None else (0.0,),
    )
    return list(dict.fromkeys(Strengths(m, w if k else 1.0, k, o) for m, w, k, o in grid))


def _chosen(
    x: Float[Tensor, "T N p"], y: Float[Tensor, "T N d"], sources: _Sources, settings: LocalFit
) -> tuple[Strengths, float, float]:
    """The strengths with the best held-out one-step likelihood, that likelihood (nats a
    transition), and the share of increments' variance that the held-out prediction explains."""
    count = x.shape[1]
    fold = torch.arange(count) % min(settings.folds, count)
    scores: list[tuple[float, float]] = []
    grid = _grid(sources, settings)
    for strengths in grid:
        likelihood = squared = 0.0
        for k in range(int(fold.max()) + 1):
            judge = fold == k
            fit = _posterior(x[:, ~judge], y[:, ~judge], sources, strengths)
            residual = y[:, judge] - x[:, judge] @ fit.F.mT - fit.f.unsqueeze(1)
            spread = fit.Sigma * (1 + 1 / float((~judge).sum()))
            likelihood += float(_log_density(residual, spread).sum())
            squared += float(residual.square().sum())
        scores.append((likelihood, squared))
    best = max(range(len(grid)), key=lambda i: scores[i][0])
    total = float((y - y.mean(dim=(0, 1))).square().sum())
    return grid[best], scores[best][0] / (count * len(x)), 1 - scores[best][1] / max(total, 1e-12)


def _log_density(
    residual: Float[Tensor, "T n d"], Sigma: Float[Tensor, "T d d"]
) -> Float[Tensor, "T n"]:
    """log N(residual | 0, Sigma)."""
    factor = torch.linalg.cholesky(Sigma)
    white = torch.linalg.solve_triangular(factor, residual.mT, upper=False)
    log_determinant = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)
    constant = residual.shape[-1] * math.log(2 * math.pi)
    density: Tensor = -0.5 * (white.square().sum(dim=-2) + log_determinant[:, None] + constant)
    return density


def _regression(x: Float[Tensor, "T N p"], y: Float[Tensor, "T N d"]) -> Increments:
    """Least squares per time step, without a prior."""
    one = torch.ones_like(x[..., :1])
    solution = torch.linalg.lstsq(torch.cat([x, one], dim=-1), y, driver="gelsd").solution
    F, f = solution[:, :-1].mT, solution[:, -1]
    residual = y - x @ F.mT - f.unsqueeze(1)
    Sigma = residual.mT @ residual / x.shape[1]
    return Increments(F, f, Sigma + LEAST_VARIANCE * torch.eye(y.shape[-1]).to(y))


def _mixture_prior(
    x: Float[Tensor, "T N p"], y: Float[Tensor, "T N d"], streams: Streams
) -> Increments:
    """LQR-FLM's fit (Levine and Abbeel 2014): a Gaussian mixture is the prior of every step."""
    points = torch.cat([x, y], dim=-1)
    flat = points.flatten(0, 1)
    fit = gmm.fit_mixture(flat, gmm.cluster_count(len(flat)), streams.generator("mixture"))
    joint = gmm.fit_joint(points, gmm.local_prior(fit.mixture, points))
    F, f, Sigma = gmm.condition_joint(joint, x.shape[-1])
    return Increments(F, f, Sigma + LEAST_VARIANCE * torch.eye(y.shape[-1]).to(y))


def _whole(increments: Increments, newest: Trajectories, prior: LatentPrior) -> LinearDynamics:
    """Dynamics of all of z from those of the newest block."""
    P, G, h = prior.basis.successor(prior.latent)
    F = G @ increments.F
    size = len(h)
    F[..., :size] += P + G @ torch.eye(prior.latent, size).to(P)
    f = increments.f @ G.T + h
    Sigma = G @ increments.Sigma @ G.T
    start = newest.z[:, 0]
    centre = start.mean(dim=0)
    weak = niw.natural(
        niw.NIW(
            Psi=LEAST_VARIANCE * torch.eye(size).to(P),
            nu=P.new_tensor(1.0),
            mu0=centre,
            kappa=P.new_tensor(1e-6),
        )
    )
    initial = niw.standard(weak.plus(niw.initial_statistics(start)))
    mu0, Sigma0 = niw.point_estimate(initial)
    return LinearDynamics(F, f, Sigma, mu0, Sigma0)
