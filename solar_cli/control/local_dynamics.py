"""INFERDYNAMICS: time-varying linear-Gaussian dynamics around the newest episodes.

Section 4.1 and appendix B: an MNIW prior per time step, conditioned on the episodes. Only the
increment of the newest latent block is inferred; the other rows of F are what shifting does. Slopes
are pooled from data that is centred per time step; offsets come from each step's exact means. Where
all episodes have ended, the dynamics of the last step that one lived in go on.

Axes: N episodes, T horizon, d latents of a block, z = W d entries, x = [z; a] with p entries.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from itertools import groupby, product
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from solar_cli.control.linear_gaussian import LinearDynamics
from solar_cli.control.trajectories import Trajectories, Transitions, compared_steps
from solar_cli.inference import cholesky, gmm, mniw
from solar_cli.models.priors import LatentPrior
from solar_cli.settings.local import LocalFit
from solar_cli.streams import Streams

ACTION_RIDGE = 1e-4  # noise of an action, in units of its std, that slopes must bear
MOST_POINTS = 5000  # that a mixture is fitted to; gps takes 20 episodes
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
    """p(u_{t+1} - u_t | x_t) = N(F x_t + f, Sigma); leading axes k are of alternatives."""

    F: Float[Tensor, "*k T d p"]
    f: Float[Tensor, "*k T d"]
    Sigma: Float[Tensor, "*k T d d"]


Fit = Callable[[Transitions, Tensor], Increments]
"""from samples to the dynamics of some time steps, or to alternatives of them"""


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
    samples = newest.transitions(prior.latent)
    past = [batch.transitions(prior.latent) for batch in older]
    metrics: dict[str, float] = {}
    fit: Fit
    if settings.method == "posterior":
        sources = _sources(samples, past, prior, settings)
        best, score = _chosen(sources, samples, settings)
        fit = partial(_posterior, sources, _reach(best), (best.model, best.older))
        metrics = {f"prior_{name}": value for name, value in best._asdict().items()}
    else:
        fits: dict[str, Fit] = {
            "regression": _regression,
            "gmm": partial(_mixture_prior, past, streams),
            "network": partial(_linearised, prior, settings),
        }
        fit = fits[settings.method]
        score = _held_out(fit, samples, settings.folds)
    metrics["one_step_log_likelihood"] = float(score.log_likelihood)
    metrics["one_step_r2"] = float(score.r2)
    every = torch.arange(len(samples.live))
    return LocalDynamics(_whole(fit(samples, every), newest, prior), metrics)


class _Score(NamedTuple):
    """One-step prediction on folds that were left out of the fit, of each alternative.

    Only `compared_steps` count.
    """

    log_likelihood: Float[Tensor, "*k"]
    """nats a transition"""
    r2: Float[Tensor, "*k"]
    """share of the increments' variance that is predicted"""


def _held_out(fit: Fit, samples: Transitions, folds: int) -> _Score:
    count, times = samples.live.shape[1], compared_steps(samples.live.sum(dim=1))
    fold, judged = torch.arange(count) % min(folds, count), samples.at(times)
    likelihood = squared = samples.y.new_zeros(())
    for k in range(int(fold.max()) + 1):
        learned, judge = samples.of(fold != k), judged.of(fold == k)
        fitted = fit(learned, times)
        residual = judge.y - judge.x @ fitted.F.mT - fitted.f.unsqueeze(-2)
        spread = fitted.Sigma * (1 + 1 / learned.counts[times, None, None])
        likelihood = likelihood + (_log_density(residual, spread) * judge.live).sum(dim=(-2, -1))
        wrong = residual.square().sum(dim=-1) * judge.live
        squared = squared + wrong.sum(dim=(-2, -1))
    total = float(judged.live.sum())
    deviation = judged.y - judged.y.sum(dim=(0, 1)) / total
    spread_of_y = float((deviation.square() * judged.live.unsqueeze(-1)).sum())
    return _Score(likelihood / total, 1 - squared / max(spread_of_y, 1e-12))


class _Sources(NamedTuple):
    """Centred statistics that a prior can be made of, one pseudo-count each."""

    ridge: mniw.RegressionStatistics
    model: mniw.RegressionStatistics | None
    older: mniw.RegressionStatistics | None


def _sources(
    samples: Transitions, past: Sequence[Transitions], prior: LatentPrior, settings: LocalFit
) -> _Sources:
    d, (x, y, live) = prior.latent, samples
    actions = x.shape[-1] - len(prior.basis.b)
    squares = (x - samples.means()[0]).square() * live.unsqueeze(-1)
    spread = (squares.sum(dim=(0, 1)) / live.sum()).sqrt()
    ridge = torch.full_like(spread, settings.ridge)  # whitened latents have unit scale
    ridge[-actions:] = ACTION_RIDGE * spread[-actions:].clamp_min(1e-6)
    degrees = y.new_tensor(d + 2.0)
    weak = mniw.RegressionStatistics(
        degrees * settings.ridge**2 * torch.eye(d).to(y),
        y.new_zeros(d, len(spread)),
        samples.counts[:, None, None] * torch.diag(ridge.square()),
        degrees,
    )
    model = None if prior.factor is None else _in_basis(prior, actions)
    if model is not None and model.n.ndim:  # one factor a time step
        model = mniw.RegressionStatistics(*(part[: len(x)] for part in model))
    if model is not None and settings.prior_counts != "own":
        model = _per_count(model)
    statistics = [_centred_statistics(batch) for batch in past]
    joined = reduce(mniw.RegressionStatistics.plus, statistics) if statistics else None
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


def _centred_statistics(samples: Transitions) -> mniw.RegressionStatistics:
    x_mean, y_mean = samples.means()
    return mniw.regression_statistics(samples.x - x_mean, samples.y - y_mean, weights=samples.live)


def _neighbourhood(horizon: int, width: float, neighbours: float) -> Float[Tensor, "T T"]:
    """Weight of step s's samples in the fit at t: 1 for its own, less for its neighbours."""
    times = torch.arange(horizon, dtype=torch.float64)
    distance = times[:, None] - times
    weight = neighbours * torch.exp(-0.5 * (distance / width).square())
    weight.fill_diagonal_(1.0)
    return weight


def _pooled(own: mniw.RegressionStatistics, weight: Tensor) -> mniw.RegressionStatistics:
    weight = weight.to(own.yy)
    return mniw.RegressionStatistics(*(torch.einsum("ts,s...->t...", weight, part) for part in own))


def _chosen(
    sources: _Sources, samples: Transitions, settings: LocalFit
) -> tuple[Strengths, _Score]:
    """The best of the grid. All pseudo-counts of one neighbourhood are judged at once."""
    found: list[tuple[Strengths, _Score]] = []
    for reach, group in groupby(sorted(_grid(sources, settings), key=_reach), key=_reach):
        alike = list(group)
        counts = [(one.model, one.older) for one in alike]
        fits = partial(_posterior, sources, reach, counts)
        scores = zip(*_held_out(fits, samples, settings.folds), strict=True)
        found += [(one, _Score(*score)) for one, score in zip(alike, scores, strict=True)]
    return max(found, key=lambda pair: float(pair[1].log_likelihood))


def _reach(strengths: Strengths) -> tuple[float, float]:
    return strengths.width, strengths.neighbours


def _posterior(
    sources: _Sources,
    reach: tuple[float, float],
    counts: Sequence[tuple[float, float]] | tuple[float, float],
    samples: Transitions,
    times: Int[Tensor, " times"],
) -> Increments:
    """The point estimate of time steps: appendix B is a sum in natural parameters.

    ``reach`` is width and weight of neighbours, ``counts`` the pseudo-counts of the model and of
    older batches; several of them are the first axis of what is returned.
    """
    own, steps = _centred_statistics(samples), samples.steps(times)
    natural = _pooled(own, _neighbourhood(len(own.n), *reach)[steps])
    model, older = own.yy.new_tensor(counts).unbind(dim=-1)
    weights = (torch.ones_like(model), model, older)
    for source, weight in zip(sources, weights, strict=True):
        if source is not None:
            natural = natural.plus(source.at(steps).scaled(weight.unsqueeze(-1)))
    F, Sigma = mniw.point_estimate(natural)
    x_mean, y_mean = samples.at(times).means()
    f = y_mean[:, 0] - (F @ x_mean.mT).squeeze(-1)
    return Increments(F, f, _bounded(Sigma))


def _bounded(Sigma: Float[Tensor, "*k d d"]) -> Float[Tensor, "*k d d"]:
    return Sigma + LEAST_VARIANCE * torch.eye(Sigma.shape[-1]).to(Sigma)


def _grid(sources: _Sources, settings: LocalFit) -> list[Strengths]:
    """All combinations that differ: no reach without neighbours, no counts without a source."""
    counts = (1.0,) if settings.prior_counts == "own" else settings.prior_counts
    grid = product(
        counts if sources.model is not None else (0.0,),
        settings.widths,
        settings.neighbours,
        settings.older_counts if sources.older is not None else (0.0,),
    )
    return list(dict.fromkeys(Strengths(m, w if k else 1.0, k, o) for m, w, k, o in grid))


def _log_density(
    residual: Float[Tensor, "*k n d"], Sigma: Float[Tensor, "*k d d"]
) -> Float[Tensor, "*k n"]:
    """log N(residual | 0, Sigma)."""
    factor = torch.linalg.cholesky(Sigma)
    white = torch.linalg.solve_triangular(factor, residual.mT, upper=False)
    log_determinant = cholesky.log_determinant(factor).unsqueeze(-1)
    constant = residual.shape[-1] * math.log(2 * math.pi)
    density: Tensor = -0.5 * (white.square().sum(dim=-2) + log_determinant + constant)
    return density


def _regression(samples: Transitions, times: Int[Tensor, " times"]) -> Increments:
    """Least squares per time step, without a prior."""
    local = samples.at(times)
    x, y, live = local
    one = live.unsqueeze(-1)
    solution = torch.linalg.lstsq(torch.cat([x, one], dim=-1), y, driver="gelsd").solution
    F, f = solution[:, :-1].mT, solution[:, -1]
    residual = (y - x @ F.mT - f.unsqueeze(1)) * one
    Sigma = residual.mT @ residual / local.counts[:, None, None]
    return Increments(F, f, _bounded(Sigma))


def _mixture_prior(
    past: Sequence[Transitions],
    streams: Streams,
    samples: Transitions,
    times: Int[Tensor, " times"],
) -> Increments:
    """LQR-FLM's fit (Levine and Abbeel 2014): a Gaussian mixture is the prior of every step.

    The mixture sees older batches too, as in the authors' release of guided policy search.
    """
    seen = [torch.cat([batch.x, batch.y], dim=-1)[batch.live > 0] for batch in (samples, *past)]
    flat, local, stream = torch.cat(seen), samples.at(times), streams.generator("mixture")
    if len(flat) > MOST_POINTS:
        flat = flat[stream.choice(len(flat), MOST_POINTS, replace=False)]
    fit = gmm.fit_mixture(flat, gmm.cluster_count(len(flat)), stream)
    points = torch.cat([local.x, local.y], dim=-1)
    joint = gmm.fit_joint(points, gmm.local_prior(fit.mixture, points, local.live), local.live)
    F, f, Sigma = gmm.condition_joint(joint, samples.x.shape[-1])
    return Increments(F, f, _bounded(Sigma))


def _linearised(
    prior: LatentPrior,
    settings: LocalFit,
    samples: Transitions,
    times: Int[Tensor, " times"],
) -> Increments:
    """The slopes of the model's own network at the mean of every time step.

    Its errors on these samples give the rest: their mean goes to the offset, as with every other
    fit, and their spread is Sigma, with a weak prior for the few samples of a step.
    """
    network, basis, d = prior.transition, prior.basis, prior.latent
    assert network is not None
    local = samples.at(times)
    x_mean, y_mean = local.means()
    states = x_mean[:, 0, : len(basis.b)]
    inverse, white = torch.linalg.inv(basis.A), basis.A[:d, :d]
    of_windows, of_actions = network.slopes(
        (states - basis.b) @ inverse.T, x_mean[:, 0, len(basis.b) :]
    )
    F = white @ torch.cat([of_windows @ inverse, of_actions], dim=-1)
    F[..., :d] -= torch.eye(d).to(F)  # increments of the newest block
    f = (y_mean - x_mean @ F.mT)[:, 0]
    residual = (local.y - local.x @ F.mT - f.unsqueeze(1)) * local.live.unsqueeze(-1)
    degrees = d + 2.0
    weak = degrees * settings.ridge**2 * torch.eye(d).to(F)
    Sigma = (residual.mT @ residual + weak) / (local.counts + degrees)[:, None, None]
    return Increments(F, f, _bounded(Sigma))


def _whole(increments: Increments, newest: Trajectories, prior: LatentPrior) -> LinearDynamics:
    """Dynamics of all of z from those of the newest block."""
    P, G, h = prior.basis.successor(prior.latent)
    F = G @ increments.F
    size = len(h)
    F[..., :size] += P + G @ torch.eye(prior.latent, size).to(P)
    f = increments.f @ G.T + h
    Sigma = G @ increments.Sigma @ G.T
    start = newest.z[:, 0]
    centred = start - start.mean(dim=0)
    Sigma0 = centred.T @ centred / len(start) + LEAST_VARIANCE * torch.eye(size).to(P)
    return LinearDynamics(F, f, Sigma, start.mean(dim=0), Sigma0)
