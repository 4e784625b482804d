"""The quadratic cost c_t = 1/2 z^T L L^T z + c^T z + alpha |a|^2 + b (section 3).

The action's part is known; L, c and b minimise the squared error of observed costs. L has a
positive diagonal, so that C = L L^T is positive definite. Fits run in whitened latents and
standardised costs, where one optimiser setting serves every task. A quadratic of 16 latents has 153
coefficients, more than a few episodes tell: how much older batches count, how large coefficients
may be, and whether each time step has its own, is chosen by held-out R2.

Axes: N episodes, T horizon, n samples of a fit, m features of z, q monomials of them. The leading
axes k are of fits that are made at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from itertools import product
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from solar_cli.control.linear_gaussian import QuadraticCost
from solar_cli.control.trajectories import Trajectories
from solar_cli.settings.local import CostFit

LBFGS_ROUNDS = 100
COMPARED_ROUNDS = 40  # of a fit per time step on a fold; its R2 is lower by up to .004 (car)
SGD_STEPS = 1000
SGD_RATE = 1e-2
PULL = 1e-3  # of a fit per time step towards the shared one, on standardised costs
FOLDS = 4


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

    def size(self) -> Float[Tensor, "*k"]:
        """Squares of the curvatures and slopes."""
        cholesky = self.cholesky()
        curvature = (cholesky @ cholesky.mT).square().sum(dim=(-2, -1))
        slope: Tensor = self.c.square().sum(dim=-1)
        return 0.5 * curvature + slope


def _monomials(z: Float[Tensor, "*k n m"]) -> Float[Tensor, "*k n q"]:
    """[z_i z_j for j <= i; z; 1]: a quadratic is linear in them."""
    i, j = torch.tril_indices(z.shape[-1], z.shape[-1])
    return torch.cat([z[..., i] * z[..., j], z, torch.ones_like(z[..., :1])], dim=-1)


class _Moments(NamedTuple):
    """Sums over the samples of one or several fits: all that a squared error needs of them."""

    xx: Float[Tensor, "*k q q"]
    xy: Float[Tensor, "*k q"]
    yy: Float[Tensor, "*k"]
    n: Float[Tensor, "*k"]
    """samples"""

    @staticmethod
    def of(
        z: Float[Tensor, "N T m"], costs: Float[Tensor, "N T"], live: Bool[Tensor, "N T"]
    ) -> _Moments:
        """Of every time step, over the episodes that were still running."""
        over = ~live.T
        x = _monomials(z.transpose(0, 1)).masked_fill(over.unsqueeze(-1), 0.0)
        y = costs.T.masked_fill(over, 0.0)
        xy = (x.mT @ y.unsqueeze(-1)).squeeze(-1)
        return _Moments(x.mT @ x, xy, y.square().sum(dim=1), live.sum(dim=0).to(y))

    @staticmethod
    def stacked(parts: Sequence[_Moments]) -> _Moments:
        """Of several fits, the new first axis."""
        return _Moments(*map(torch.stack, zip(*parts, strict=True)))

    def error(self, quadratic: _Quadratic) -> Float[Tensor, "*k"]:
        """Sum of squared errors."""
        w = quadratic.coefficients()
        explained: Tensor = (w * (torch.einsum("...ij,...j->...i", self.xx, w) - 2 * self.xy)).sum(
            dim=-1
        )
        return explained + self.yy

    def each(self, change: Callable[[Tensor], Tensor]) -> _Moments:
        """The same done to all of them."""
        return _Moments(*(change(part) for part in self))

    def together(self) -> _Moments:
        """Of the samples of all fits of the first axis: time steps, or folds."""
        return self.each(lambda part: part.sum(dim=0))

    def plus(self, other: _Moments) -> _Moments:
        """Of the samples of both."""
        return _Moments(*(a + b for a, b in zip(self, other, strict=True)))

    def minus(self, other: _Moments) -> _Moments:
        """Without the samples of the other."""
        return _Moments(*(a - b for a, b in zip(self, other, strict=True)))

    def mean(self) -> _Moments:
        """Means over samples; zero where there are none."""
        n = self.n.clamp_min(1e-9)
        return _Moments(self.xx / n[..., None, None], self.xy / n[..., None], self.yy / n, self.n)


class Choice(NamedTuple):
    """What held-out R2 decides."""

    older: float
    """weight of older samples"""
    ridge: float
    """weight of squared coefficients"""
    per_time: bool
    """whether a fit per time step won"""


class FittedCost(NamedTuple):
    """A fitted cost and how good it is."""

    model: QuadraticCost
    r2: float
    """share of the variance of held-out costs that is explained; by a fit per time step, after
    `COMPARED_ROUNDS` of it"""
    choice: Choice

    @property
    def metrics(self) -> dict[str, float]:
        """To be stored."""
        chosen = {f"cost_{name}": float(value) for name, value in self.choice._asdict().items()}
        return {"cost_r2": self.r2, **chosen}


def fit_quadratic_cost(
    states: Trajectories,
    older: Sequence[Trajectories],
    action_cost: float,
    settings: CostFit,
    features: int,
) -> FittedCost:
    """Fit on the first ``features`` entries of z: one fit for all time steps, and one per time
    step where held-out R2 says that it is better.

    ``older`` batches may support the shared fit. The cost of the last state, which is never
    observed, is the last fit's times ``settings.terminal``.
    """
    costs = _of_states(states, action_cost)
    mean, scale = costs[states.live].mean(), costs[states.live].std().clamp_min(1e-9)
    fold = torch.arange(len(costs)) % min(FOLDS, len(costs))

    def standardised(batch: Trajectories) -> _Moments:
        """Of every time step."""
        y = (_of_states(batch, action_cost) - mean) / scale
        return _Moments.of(batch.z[:, :-1, :features], y, batch.live)

    folds = [standardised(states.only(fold == k)) for k in range(int(fold.max()) + 1)]
    whole = reduce(_Moments.plus, folds)
    past = [standardised(batch).together() for batch in older]
    support = reduce(_Moments.plus, past) if past else None
    scores = _held_out(folds, whole, support, settings)
    best = max(scores, key=lambda choice: scores[choice])
    shared = _fit_shared(whole.together(), support, [best], settings)
    fit = _Quadratic(*(part.squeeze(0) for part in shared))
    if best.per_time:
        fit = _fit_each(whole, fit, settings, LBFGS_ROUNDS)
    model = _assembled(fit, states, action_cost, mean, scale, settings.terminal)
    return FittedCost(model, scores[best], best)


def _of_states(batch: Trajectories, action_cost: float) -> Float[Tensor, "N T"]:
    """Costs without the action's part."""
    return batch.costs - action_cost * batch.actions.square().sum(dim=-1)


def _held_out(
    folds: list[_Moments], whole: _Moments, support: _Moments | None, settings: CostFit
) -> dict[Choice, float]:
    """R2 of every choice on the episodes that a fit was not given; ``whole`` is of all folds.

    Whether fits per time step are better is asked of the best shared one only.
    """

    def given(judges: _Moments, every: _Moments) -> _Moments:
        """What fits are made from: all but what judges them, unless there is nothing else."""
        return every.minus(judges) if len(folds) > 1 else judges

    judges = _Moments.stacked([fold.together() for fold in folds])
    weights = settings.older if support is not None else (0.0,)
    choices = [Choice(w, ridge, per_time=False) for w, ridge in product(weights, settings.ridge)]
    spread = float(judges.yy.sum())
    if spread <= 1e-12 * float(judges.n.sum()):  # nothing to explain
        return dict.fromkeys(choices, 1.0)
    fits = _fit_shared(given(judges, judges.together()), support, choices, settings)
    r2 = 1 - judges.error(fits).sum(dim=1) / spread
    scores = dict(zip(choices, r2.tolist(), strict=True))
    if settings.per_time == "never":
        return scores
    best, error = int(r2.argmax()), 0.0
    for k, fold in enumerate(folds):  # not all at once: moments of every time step fill the memory
        shared = _Quadratic(*(part[best, k] for part in fits))
        fit = _fit_each(given(fold, whole), shared, settings, COMPARED_ROUNDS)
        error += float(fold.error(fit).sum())
    return {**scores, choices[best]._replace(per_time=True): 1 - error / spread}


def _fit_shared(
    moments: _Moments,
    support: _Moments | None,
    choices: list[Choice],
    settings: CostFit,
) -> _Quadratic:
    """One fit for all time steps, of each choice and each of the moments: axes (choices, *k).

    ``support`` are moments of older batches.
    """
    weights = moments.n.new_tensor([choice[:2] for choice in choices])
    older, ridge = weights.T.view(2, len(choices), *(1,) * moments.n.ndim)
    samples = moments.each(lambda part: part.expand(len(choices), *part.shape))
    if support is not None:
        samples = samples.plus(support.each(lambda part: _times(older, part)))
    mean = samples.mean()
    q, axes = mean.xy.shape[-1], mean.n.shape
    m = round((2 * q + 0.25) ** 0.5 - 1.5)  # q = m (m + 1) / 2 + m + 1
    start = _Quadratic(
        -torch.eye(m).to(mean.xy).repeat(*axes, 1, 1),
        mean.xy.new_zeros(*axes, m),
        mean.xy.new_zeros(axes),
    )

    def objective(w: _Quadratic) -> Tensor:
        loss: Tensor = (mean.error(w) + ridge * w.size()).sum()
        return loss

    return _minimise(start, objective, settings, LBFGS_ROUNDS)


def _times(weight: Float[Tensor, "*k"], part: Float[Tensor, "*q"]) -> Float[Tensor, "*k *q"]:
    return weight.view(*weight.shape, *(1,) * part.ndim) * part


def _fit_each(moments: _Moments, shared: _Quadratic, settings: CostFit, rounds: int) -> _Quadratic:
    """One fit a time step, the axis of the moments; neighbours count with a Gaussian weight.

    A time step far from all samples gets the shared fit.
    """
    times = torch.arange(len(moments.n), device=moments.n.device)
    distance = (times[:, None] - times).abs()
    reach = max(1, round(2 * settings.width))
    weight = torch.exp(-0.5 * (distance / settings.width).square()) * (distance <= reach)
    weight = weight.to(moments.xx)
    own = moments.each(lambda part: torch.tensordot(weight, part, dims=([1], [0]))).mean()
    start = _Quadratic(*(part.expand(len(times), *part.shape) for part in shared))

    def objective(w: _Quadratic) -> Tensor:
        away = sum((a - b).square().sum() for a, b in zip(w, shared, strict=True))
        return own.error(w).sum() + PULL * away

    return _minimise(start, objective, settings, rounds)


def _minimise(
    start: _Quadratic, objective: Callable[[_Quadratic], Tensor], settings: CostFit, rounds: int
) -> _Quadratic:
    parameters = [part.detach().clone().requires_grad_() for part in start]
    quadratic = _Quadratic(*parameters)
    optimiser: torch.optim.Optimizer
    if settings.optimiser == "sgd":
        optimiser, calls = torch.optim.SGD(parameters, SGD_RATE, momentum=0.9), SGD_STEPS
    else:
        optimiser = torch.optim.LBFGS(
            parameters, max_iter=rounds, line_search_fn="strong_wolfe", tolerance_change=1e-10
        )
        calls = 1

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss: Tensor = objective(quadratic)
        torch.autograd.backward(loss)
        return loss

    for _ in range(calls):
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
