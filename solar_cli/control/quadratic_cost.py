"""The quadratic cost c_t = 1/2 z^T L L^T z + c^T z + alpha |a|^2 + b (section 3).

The action's part is known; L, c and b minimise the squared error of observed costs. L has a
positive diagonal, so that C = L L^T is positive definite. Fits run in whitened latents and
standardised costs, where one optimiser setting serves every task.
"""

from __future__ import annotations

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
    """Parameters of one or several fits over m features of z."""

    L: Float[Tensor, "*k m m"]
    c: Float[Tensor, "*k m"]
    b: Float[Tensor, "*k"]

    def cholesky(self) -> Float[Tensor, "*k m m"]:
        """Lower-triangular with a positive diagonal."""
        diagonal = torch.diagonal(self.L, dim1=-2, dim2=-1)
        return self.L.tril(-1) + torch.diag_embed(torch.nn.functional.softplus(diagonal))

    def value(self, z: Float[Tensor, "*k n m"]) -> Float[Tensor, "*k n"]:
        """The quadratic form at every sample."""
        half = z @ self.cholesky()
        return (
            0.5 * half.square().sum(dim=-1)
            + (z @ self.c.unsqueeze(-1)).squeeze(-1)
            + self.b.unsqueeze(-1)
        )


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


def _fit_shared(
    z: Float[Tensor, "N T m"],
    target: Float[Tensor, "N T"],
    live: Bool[Tensor, "N T"],
    settings: CostFit,
) -> _Quadratic:
    m = z.shape[-1]
    start = _Quadratic(
        torch.zeros(m, m, dtype=z.dtype, device=z.device) - 1.0 * torch.eye(m, device=z.device),
        torch.zeros(m, dtype=z.dtype, device=z.device),
        torch.zeros((), dtype=z.dtype, device=z.device),
    )
    flat, y = z[live], target[live]
    return _minimise(start, lambda q: (q.value(flat) - y).square().mean(), settings)


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
    reach = max(1, round(2 * settings.width))
    offsets = torch.arange(-reach, reach + 1, device=z.device)
    near = times[:, None] + offsets
    inside = (near >= 0) & (near < horizon)
    near = near.clamp(0, horizon - 1)
    weight = torch.exp(-0.5 * (offsets / settings.width).square()) * inside
    total = (weight * live.to(weight).mean(dim=0)[near]).sum(dim=1, keepdim=True)
    weight = (weight / torch.where(total > 0, total, 1.0)).to(z.dtype)
    # (T, neighbours x N, m): every time step sees its own and its neighbours' samples.
    samples = z[:, near].permute(1, 2, 0, 3).flatten(1, 2)
    observed = target[:, near].permute(1, 2, 0).flatten(1, 2)
    counted = live[:, near].permute(1, 2, 0).flatten(1, 2)
    weights = weight.repeat_interleave(len(z), dim=1) / len(z) * counted
    start = _Quadratic(*(part.expand(horizon, *part.shape).clone() for part in shared))

    def objective(q: _Quadratic) -> Tensor:
        error = (weights * (q.value(samples) - observed).square()).sum()
        pull = sum((a - b).square().sum() for a, b in zip(q, shared, strict=True))
        return error + PULL * pull

    return _minimise(start, objective, settings)


def _minimise(start: _Quadratic, objective, settings: CostFit) -> _Quadratic:  # type: ignore[no-untyped-def]
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
