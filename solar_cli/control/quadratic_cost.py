"""The quadratic cost c_t = 1/2 z^T L L^T z + c^T z + alpha |a|^2 + b (section 3).

The action's part is known; L, c and b minimise the squared error of observed costs. L has a
positive diagonal, so that C = L L^T is positive definite. Fits run in whitened latents and
standardised costs, where one optimiser setting serves every task.

Axes: N episodes, T horizon, n samples of a fit, m features of z, q monomials of them. The leading
axis k is of fits that are made at once: T, or none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from solar_cli.control.linear_gaussian import QuadraticCost
from solar_cli.control.trajectories import Trajectories
from solar_cli.settings.local import CostFit

LBFGS_ROUNDS = 100
SGD_STEPS = 1000
SGD_RATE = 1e-2
PULL = 1e-3  # of a fit per time step towards the global one, on standardised costs


class _Quadratic(NamedTuple):
    """Parameters of one or several fits."""

    L: Float[Tensor, "*k m m"]
    c: Float[Tensor, "*k m"]
    b: Float[Tensor, "*k"]

    def cholesky(self) -> Float[Tensor, "*k m m"]:
        """Lower-triangular with a positive diagonal."""
        diagonal = torch.diagonal(self.L, dim1=-2, dim2=-1)
        return self.L.tril(-1) + torch.diag_embed(torch.nn.functional.softplus(diagonal))

    def coefficients(self) -> Float[Tensor, "*k q"]:
        """Weights of `_monomials`."""
        cholesky = self.cholesky()
        C = cholesky @ cholesky.mT
        pairs = torch.tril_indices(*C.shape[-2:])
        halves = torch.where(pairs[0] == pairs[1], 0.5, 1.0).to(C)
        return torch.cat([halves * C[..., *pairs], self.c, self.b.unsqueeze(-1)], dim=-1)

    def value(self, z: Float[Tensor, "*k n m"]) -> Float[Tensor, "*k n"]:
        """The quadratic form at every sample."""
        return (_monomials(z) @ self.coefficients().unsqueeze(-1)).squeeze(-1)


def _monomials(z: Float[Tensor, "*k n m"]) -> Float[Tensor, "*k n q"]:
    """[z_i z_j for j <= i; z; 1]: a quadratic is linear in them."""
    i, j = torch.tril_indices(z.shape[-1], z.shape[-1])
    return torch.cat([z[..., i] * z[..., j], z, torch.ones_like(z[..., :1])], dim=-1)


class _Moments(NamedTuple):
    """Means over the samples of one or several fits: all that a squared error needs of them."""

    xx: Float[Tensor, "*k q q"]
    xy: Float[Tensor, "*k q"]
    yy: Float[Tensor, "*k"]

    def error(self, quadratic: _Quadratic) -> Float[Tensor, "*k"]:
        """Mean squared error."""
        w = quadratic.coefficients()
        explained: Tensor = (w * (torch.einsum("...ij,...j->...i", self.xx, w) - 2 * self.xy)).sum(
            dim=-1
        )
        return explained + self.yy


class FittedCost(NamedTuple):
    """A fitted cost and how good it is."""

    model: QuadraticCost
    r2: float
    """share of the variance of held-out costs that is explained"""
    per_time: bool
    """whether a fit per time step won"""


def fit_quadratic_cost(
    states: Trajectories, action_cost: float, settings: CostFit, features: int
) -> FittedCost:
    """Fit on the first ``features`` entries of z: one fit for all time steps, and one per time
    step where held-out R2 says that it is better.

    The cost of the last state, which is never observed, is the last fit's times
    ``settings.terminal``.
    """
    z, live = states.z[:, :-1, :features], states.live
    y = states.costs - action_cost * states.actions.square().sum(dim=-1)
    mean, scale = y[live].mean(), y[live].std().clamp_min(1e-9)
    target = (y - mean) / scale
    held_out = torch.arange(len(z)) % 5 == 4
    if len(z) < 5:
        held_out = torch.arange(len(z)) == len(z) - 1
    fit, judge = ~held_out, held_out
    shared = _fit_shared(z[fit], target[fit], live[fit], settings)
    judged, observed = live[judge], target[judge][live[judge]]
    r2 = _r2(shared.value(z[judge][judged]), observed)
    per_time = False
    if settings.per_time == "chosen":
        each = _fit_each(z[fit], target[fit], live[fit], shared, settings)
        predicted = each.value(z[judge].transpose(0, 1)).transpose(0, 1)
        each_r2 = _r2(predicted[judged], observed)
        per_time, r2 = each_r2 > r2, max(r2, each_r2)
    best = _fit_shared(z, target, live, settings)
    if per_time:
        best = _fit_each(z, target, live, best, settings)
    model = _assembled(best, states, action_cost, mean, scale, settings.terminal)
    return FittedCost(model, r2, per_time)


def explained(model: QuadraticCost, states: Trajectories) -> float:
    """R2 of a fitted cost on other episodes."""
    x = torch.cat([states.z[:, :-1], states.actions], dim=-1)
    quadratic = 0.5 * torch.einsum("nti,tij,ntj->nt", x, model.C[:-1], x)
    predicted = quadratic + torch.einsum("nti,ti->nt", x, model.c[:-1]) + model.b[:-1]
    return _r2(predicted[states.live], states.costs[states.live])


def _r2(predicted: Tensor, observed: Tensor) -> float:
    residual = (predicted - observed).square().mean()
    spread = (observed - observed.mean()).square().mean()
    # A cost that does not vary holds nothing to explain.
    return float(1 - residual / spread) if spread > 1e-18 else 1.0


def _moments(
    z: Float[Tensor, "N T m"], target: Float[Tensor, "N T"], live: Bool[Tensor, "N T"]
) -> _Moments:
    """Sums over the episodes that were still running, over N, for every time step."""
    over, count = ~live.T, len(z)
    x = _monomials(z.transpose(0, 1)).masked_fill(over.unsqueeze(-1), 0.0)
    y = target.T.masked_fill(over, 0.0)
    xy = (x.mT @ y.unsqueeze(-1)).squeeze(-1)
    return _Moments(x.mT @ x / count, xy / count, y.square().mean(dim=1))


def _fit_shared(
    z: Float[Tensor, "N T m"],
    target: Float[Tensor, "N T"],
    live: Bool[Tensor, "N T"],
    settings: CostFit,
) -> _Quadratic:
    m = z.shape[-1]
    start = _Quadratic(
        torch.zeros(m, m, dtype=z.dtype, device=z.device) - torch.eye(m, device=z.device),
        torch.zeros(m, dtype=z.dtype, device=z.device),
        torch.zeros((), dtype=z.dtype, device=z.device),
    )
    share = live.to(z).mean()
    moments = _Moments(*(part.mean(dim=0) / share for part in _moments(z, target, live)))
    return _minimise(start, moments.error, settings)


def _fit_each(
    z: Float[Tensor, "N T m"],
    target: Float[Tensor, "N T"],
    live: Bool[Tensor, "N T"],
    shared: _Quadratic,
    settings: CostFit,
) -> _Quadratic:
    """One fit a time step; samples of neighbouring steps count with a Gaussian weight.

    A time step far from all samples gets the shared fit.
    """
    horizon = z.shape[1]
    times = torch.arange(horizon, device=z.device)
    distance = (times[:, None] - times).abs()
    reach = max(1, round(2 * settings.width))
    weight = torch.exp(-0.5 * (distance / settings.width).square()) * (distance <= reach)
    total = (weight * live.to(weight).mean(dim=0)).sum(dim=1, keepdim=True)
    weight = (weight / torch.where(total > 0, total, 1.0)).to(z.dtype)
    own = _moments(z, target, live)
    moments = _Moments(*(torch.einsum("ts,s...->t...", weight, part) for part in own))
    start = _Quadratic(*(part.expand(horizon, *part.shape).clone() for part in shared))

    def objective(q: _Quadratic) -> Tensor:
        pull = sum((a - b).square().sum() for a, b in zip(q, shared, strict=True))
        return moments.error(q).sum() + PULL * pull

    return _minimise(start, objective, settings)


def _minimise(
    start: _Quadratic, objective: Callable[[_Quadratic], Tensor], settings: CostFit
) -> _Quadratic:
    parameters = [part.detach().clone().requires_grad_() for part in start]
    quadratic = _Quadratic(*parameters)
    optimiser: torch.optim.Optimizer
    if settings.optimiser == "sgd":
        optimiser, rounds = torch.optim.SGD(parameters, SGD_RATE, momentum=0.9), SGD_STEPS
    else:
        optimiser = torch.optim.LBFGS(
            parameters, max_iter=LBFGS_ROUNDS, line_search_fn="strong_wolfe", tolerance_change=1e-10
        )
        rounds = 1

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss: Tensor = objective(quadratic)
        torch.autograd.backward(loss)
        return loss

    for _ in range(rounds):
        optimiser.step(closure)  # type: ignore[no-untyped-call]
    return _Quadratic(*(part.detach() for part in parameters))


def _assembled(
    fit: _Quadratic,
    states: Trajectories,
    action_cost: float,
    mean: Tensor,
    scale: Tensor,
    terminal: float,
) -> QuadraticCost:
    """The fit in the units of the cost, over [z; a], for t = 0..T."""
    horizon, d, a = states.actions.shape[1], states.z.shape[-1], states.actions.shape[-1]
    m = fit.c.shape[-1]
    cholesky = fit.cholesky()
    C = states.z.new_zeros(horizon + 1, d + a, d + a)
    c = states.z.new_zeros(horizon + 1, d + a)
    b = states.z.new_zeros(horizon + 1)
    C[:-1, :m, :m] = scale * cholesky @ cholesky.mT
    c[:-1, :m] = scale * fit.c
    b[:-1] = scale * fit.b + mean
    C[-1], c[-1], b[-1] = (terminal * part[-2] for part in (C, c, b))
    C[:-1, d:, d:] = 2 * action_cost * torch.eye(a, dtype=C.dtype, device=C.device)
    return QuadraticCost(C, c, b)
