"""The quadratic cost c_t = 1/2 z^T L L^T z + c^T z + alpha |a|^2 + b (section 3).

The action's part is known; C = L L^T, c and b minimise the squared error of observed costs. Fits
are of whitened latents and standardised costs, where one ridge serves every task. A quadratic of 16
latents has 153 coefficients, more than a few episodes tell: how much older batches count, how large
coefficients may be, and whether each time step has its own, is chosen by held-out costs.

Of a cost that falls from 11 cm to 1, R2 is near 1 as soon as a fit knows that it falls. Control
needs what episodes differ by at the same time step. Where the best fit hardly tells that, the cost
is not quadratic over the whole of the episodes, and fits around them are tried (`local_cost`).

Axes: N episodes, T horizon, m features of z, q monomials of them. The leading axes k are of fits
that are made at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, reduce
from itertools import product
from operator import itemgetter
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from solar_cli.control.convex_quadratic import Moments, descended, least_squares
from solar_cli.control.linear_gaussian import QuadraticCost
from solar_cli.control.local_cost import LEAST_EPISODES, Samples, Surroundings, fitted_around
from solar_cli.control.trajectories import Trajectories, compared_steps
from solar_cli.inference import quadratics
from solar_cli.settings.local import CostFit

ROUNDS = 30
"""of the shared fit; in those per time step they change held-out R2 by .015 at most, to either side
(batches of nav, car, reacher and Sawyer)"""
LEAST_RIDGE = 1e-8  # where samples do not tell all coefficients, and no ridge was asked for
PULL = 0.03
"""of a fit per time step towards the shared one, on standardised costs; .1 is better where costs
hardly vary (Sawyer: held-out R2 .70 for .69, at .001 .49), less where they do"""
FOLDS = 4
ALIKE = 1e-12  # variance of standardised costs below which there is nothing to explain
ENOUGH = 0.9
"""share of what costs differ by at a time step. Of fits for all time steps it is .93 and more on
nav, car and pusher, .86 and more on reacher, .5 on the pole, and on the true state of Sawyer, whose
cost is a sum of distances, .9 at first and .4 to .8 later"""


class Choice(NamedTuple):
    """What held-out costs decide."""

    older: float
    """weight of older samples"""
    ridge: float
    """weight of squared coefficients"""
    per_time: bool
    """whether a fit per time step won"""
    around: bool = False
    """whether fits around the episodes won"""


class Score(NamedTuple):
    """How much of held-out costs is explained."""

    r2: float
    """of their variance; where fits per time step won, an estimate from some time steps"""
    within: float
    """of what they differ by at the same time step, which is what control needs"""


class Squares(NamedTuple):
    """Sums of squares of held-out costs, or of what a fit leaves of them."""

    every: float
    within: float
    """about their mean at each time step"""


class Around(NamedTuple):
    """What fits around the episodes are made from."""

    surroundings: Surroundings
    samples: Samples


class FittedCost(NamedTuple):
    """A fitted cost and how good it is."""

    model: QuadraticCost
    r2: float
    within: float
    """as `Score` says"""
    choice: Choice

    @property
    def metrics(self) -> dict[str, float]:
        """To be stored."""
        chosen = {f"cost_{name}": float(value) for name, value in self.choice._asdict().items()}
        return {"cost_r2": self.r2, "cost_r2_within": self.within, **chosen}


def fit_quadratic_cost(
    states: Trajectories,
    older: Sequence[Trajectories],
    action_cost: float,
    settings: CostFit,
    features: int,
) -> FittedCost:
    """Fit on the first ``features`` entries of z: one fit for all time steps, or one per time step,
    of neighbouring ones or around the episodes, where held-out costs say that it is better.

    ``older`` batches may support the shared fit. The cost of the last state, which is never
    observed, is the last fit's times ``settings.terminal``.
    """
    costs = _of_states(states, action_cost)
    mean, scale = costs[states.live].mean(), costs[states.live].std().clamp_min(1e-9)
    fold = torch.arange(len(costs)) % min(FOLDS, len(costs))

    def seen(
        batch: Trajectories,
    ) -> tuple[Float[Tensor, "N T m"], Float[Tensor, "N T"], Bool[Tensor, "N T"]]:
        """States, standardised costs, and where both count."""
        y = (_of_states(batch, action_cost) - mean) / scale
        return batch.z[:, :-1, :features], y, batch.live

    folds = [Moments.of(*seen(states.only(fold == k))) for k in range(int(fold.max()) + 1)]
    whole = reduce(Moments.plus, folds)
    past = [Moments.of(*seen(batch)).together() for batch in older]
    support = reduce(Moments.plus, past) if past else None

    @cache
    def around() -> Around:
        z, y, live = seen(states)
        return Around(Surroundings.of(z, live), Samples.of(z, y, live, fold))

    best, score = _chosen(folds, whole, support, around, settings)
    w = _fit_shared(whole.together(), support, [best], settings)[0]
    if best.around:
        w = fitted_around(*around(), [w], [None])[0]
    elif best.per_time:
        every = torch.arange(len(whole.n))
        w = _fit_each(_near(whole, every, settings.width), w)
    model = _assembled(w, states, features, action_cost, mean, scale, settings.terminal)
    return FittedCost(model, *score, best)


def _of_states(batch: Trajectories, action_cost: float) -> Float[Tensor, "N T"]:
    """Costs without the action's part."""
    return batch.costs - action_cost * batch.actions.square().sum(dim=-1)


def _chosen(
    folds: list[Moments],
    whole: Moments,
    support: Moments | None,
    around: Callable[[], Around],
    settings: CostFit,
) -> tuple[Choice, Score]:
    """The best choice, on the episodes that its fits were not given; ``whole`` is of all folds.

    Fits per time step are compared with the best shared one at `compared_steps`. Their error in
    all is taken to be its error in all, times the ratio of both at these steps. Fits around the
    episodes are compared by what costs differ by at a time step, where the best of the others tells
    too little of that.
    """

    def given(judges: Moments, every: Moments) -> Moments:
        """What fits are made from: all but what judges them, unless there is nothing else."""
        return every.minus(judges) if len(folds) > 1 else judges

    judges = Moments.stacked([fold.together() for fold in folds])
    weights = settings.older if support is not None else (0.0,)
    choices = [Choice(w, ridge, per_time=False) for w, ridge in product(weights, settings.ridge)]
    spread = float(judges.yy.sum())
    nothing = ALIKE * float(judges.n.sum())
    if spread <= nothing:
        return choices[0], Score(1.0, 1.0)
    fits = _fit_shared(given(judges, judges.together()), support, choices, settings)
    r2 = 1 - judges.error(fits).sum(dim=1) / spread
    shared, best, times = fits[int(r2.argmax())], choices[int(r2.argmax())], compared_steps(whole.n)
    costs, together = (_squares(folds, times, w) for w in (torch.zeros_like(shared), shared))

    def score(left: Squares) -> Score:
        """Of what is left by fits that were each made without the fold that judges it."""
        ratio = left.every / max(together.every, 1e-12)
        within = 1 - left.within / costs.within if costs.within > nothing else 1.0
        return Score(1 - ratio * (1 - float(r2.max())), within)

    found = {best: score(together)._replace(r2=float(r2.max()))}
    if settings.per_time == "never":
        return best, found[best]
    near = [_near(fold, times, settings.width) for fold in folds]
    every = reduce(Moments.plus, near)
    each = [_fit_each(given(own, every), w) for own, w in zip(near, shared, strict=True)]
    found[best._replace(per_time=True)] = score(_squares(folds, times, each))
    winner = max(found, key=lambda choice: found[choice].r2)
    if found[winner].within < ENOUGH and float(whole.n.max()) >= LEAST_EPISODES:
        surroundings, samples = around()
        local = fitted_around(surroundings.at(times), samples, list(shared), range(len(folds)))
        found[best._replace(around=True)] = score(_squares(folds, times, local))
        winner = max((winner, best._replace(around=True)), key=lambda choice: found[choice].within)
    return winner, found[winner]


def _squares(
    folds: list[Moments], times: Int[Tensor, " times"], fits: Sequence[Tensor] | Tensor
) -> Squares:
    """What the fit of each fold leaves of the costs that it is judged by."""
    judges = [(fold.each(itemgetter(times)), w) for fold, w in zip(folds, fits, strict=True)]
    error = torch.stack([judge.error(w) for judge, w in judges]).sum(dim=0)
    surplus = torch.stack([judge.surplus(w) for judge, w in judges]).sum(dim=0)
    count = torch.stack([judge.n for judge, _ in judges]).sum(dim=0).clamp_min(1.0)
    return Squares(float(error.sum()), float((error - surplus.square() / count).sum()))


def _fit_shared(
    moments: Moments,
    support: Moments | None,
    choices: list[Choice],
    settings: CostFit,
) -> Float[Tensor, "choices *k q"]:
    """Coefficients of one fit for all time steps, of each choice and each of the moments.

    ``support`` are moments of older batches.
    """
    weights = moments.n.new_tensor([choice[:2] for choice in choices])
    older, ridge = weights.T.view(2, len(choices), *(1,) * moments.n.ndim)
    samples = moments.each(lambda part: part.expand(len(choices), *part.shape))
    if support is not None:
        samples = samples.plus(support.each(lambda part: _times(older, part)))
    mean = samples.mean()
    size = quadratics.squares(mean.xy.shape[-1]).to(mean.xy)
    penalty = ridge.clamp_min(LEAST_RIDGE).unsqueeze(-1) * size
    if settings.optimiser == "sgd":
        return descended(mean, penalty)
    return least_squares(mean, penalty, torch.zeros_like(mean.xy), ROUNDS)


def _times(weight: Float[Tensor, "*k"], part: Float[Tensor, "*q"]) -> Float[Tensor, "*k *q"]:
    return weight.view(*weight.shape, *(1,) * part.ndim) * part


def _near(moments: Moments, times: Int[Tensor, " times"], width: float) -> Moments:
    """Of time steps with their neighbours, which count with a Gaussian weight."""
    distance = (times[:, None] - torch.arange(len(moments.n))).abs()
    weight = torch.exp(-0.5 * (distance / width).square())
    weight = (weight * (distance <= max(1, round(2 * width)))).to(moments.xx)
    return moments.each(lambda part: torch.tensordot(weight, part, dims=([1], [0])))


def _fit_each(near: Moments, shared: Float[Tensor, " q"]) -> Float[Tensor, "times q"]:
    """One fit a time step, the axis of the moments.

    A time step far from all samples gets the shared fit.
    """
    penalty = PULL * quadratics.squares(len(shared)).to(shared).clamp_min(1.0)
    return least_squares(near.mean(), penalty, shared, rounds=0)


def _assembled(
    w: Float[Tensor, "*T q"],
    states: Trajectories,
    features: int,
    action_cost: float,
    mean: Tensor,
    scale: Tensor,
    terminal: float,
) -> QuadraticCost:
    """The fit in the units of the cost, over [z; a], for t = 0..T."""
    horizon, d, a = states.actions.shape[1], states.z.shape[-1], states.actions.shape[-1]
    C = states.z.new_zeros(horizon + 1, d + a, d + a)
    c = states.z.new_zeros(horizon + 1, d + a)
    b = states.z.new_zeros(horizon + 1)
    C[:-1, :features, :features] = scale * quadratics.curvature(w)
    c[:-1, :features] = scale * w[..., -features - 1 : -1]
    b[:-1] = scale * w[..., -1] + mean
    C[-1], c[-1], b[-1] = (terminal * part[-2] for part in (C, c, b))
    C[:-1, d:, d:] = 2 * action_cost * torch.eye(a, dtype=C.dtype, device=C.device)
    return QuadraticCost(C, c, b)
