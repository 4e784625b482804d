"""Two things that a task may lack for local control to work, checked on collected episodes.

A state must show what the last action did, and episodes must be free to move. Nothing here changes
what is learned. Both checks lean on the policy's noise: it is drawn at random, so that what goes
with it is its doing, however noisy latents are.

Axes: N episodes, T horizon, z entries of a state, d latents of its newest block, a of an action,
n transitions of all batches, L actions back in time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from solar_cli.control.local_dynamics import LEAST_VARIANCE
from solar_cli.control.trajectories import Trajectories

ACTIONS = 4
"""that are told apart: the last one, two before it, and one that answers for those still older"""
LEVEL = 0.01
"""of either error: to see an effect that is none, to miss one half as strong as an earlier's"""
JUDGED = 10_000
"""transitions at most: bounds memory"""

LEAST_STEPS, LEAST_EPISODES = 5, 5
RESTING = 0.2
"""of how far episodes come in a tenth of their time: less is at rest"""
HELD = 1e-3
"""of the span of an episode's costs that it is above its least: 3 % of a distance, squared"""
UNMOVED = 5.0
"""standard deviations over episodes by which they are above it. With a third or more of the first
noise: 9 to 22 for a car at a wall, 0.3 to 3.4 for one that stops where nothing holds it"""


def task_metrics(
    newest: Trajectories,
    older: Sequence[Trajectories],
    d: int,
    action_cost: float,
    bound: float,
) -> dict[str, float]:
    """Metrics of an iteration; actions were clipped at ``bound``.

    ``last_action_p_value``: of the newest block's increment being independent of the last action.
    ``action_seen_late``: 1 where it is, but not of an earlier one, else 0. ``stuck``: 1 where
    episodes come to rest above their least cost, whatever their noise, else 0.
    """
    p_value, late = last_action([newest, *older], d, bound)
    return {
        "last_action_p_value": p_value,
        "action_seen_late": float(late),
        "stuck": float(is_stuck(newest, d, action_cost)),
    }


class _Samples(NamedTuple):
    """Transitions of the episodes with noise, centred per time step.

    Those that an action at its bound led to are left out: what clipping leaves of its noise is a
    function of the state.
    """

    z: Float[Tensor, "n z"]
    noise: Float[Tensor, "L n a"]
    """of the last action first; zero before the start of an episode"""
    y: Float[Tensor, "n d"]
    """increments of the newest block"""
    free: int
    """degrees of freedom that centring leaves"""


def last_action(batches: Sequence[Trajectories], d: int, bound: float) -> tuple[float, bool]:
    """The p value of the last action, and whether an earlier one is seen in its place.

    F tests of nested regressions of the increments on the state and the last actions' noise, each
    action against all others (Lawley and Hotelling's trace). Where the state hides a velocity, or
    is noisy, earlier actions show too, but the last one no less. It counts as unseen only where an
    effect half as strong as the strongest earlier one would have been seen. Noise that is smooth in
    time tells actions apart less well: then both may stay open, and nothing is said.
    """
    z, noise, y, free = _joined([_samples(batch, d, bound) for batch in batches])
    entries = d * noise.shape[-1]
    free -= z.shape[-1] + ACTIONS * noise.shape[-1]
    if free < 2 * d:
        return 1.0, False
    residual = _unexplained(y, torch.cat([z, *noise], dim=-1))
    factor, within = _factor(residual.T @ residual / free), free - d + 1

    def statistic(back: int) -> float:
        """``entries`` on average where the action so many steps back has no effect."""
        others = torch.cat([z, *(noise[k] for k in range(ACTIONS) if k != back)], dim=-1)
        own = torch.linalg.qr(_unexplained(noise[back], others)).Q
        explained = _unexplained(y, others).T @ own
        white = torch.linalg.solve_triangular(factor, explained, upper=False)
        return float(white.square().sum()) * within / free

    p_value = float(stats.f.sf(statistic(0) / entries, entries, within))
    seen_from = entries * float(stats.f.isf(LEVEL, entries, within))
    # Statistics add squares of effects: half an effect is a quarter of what exceeds chance.
    quarter = max(0.0, *(statistic(back) - entries for back in range(1, ACTIONS - 1))) / 4
    spread = math.sqrt(2 * entries + 4 * quarter)  # of a noncentral chi square
    would_be_seen = entries + quarter - float(stats.norm.isf(LEVEL)) * spread > seen_from
    return p_value, p_value > LEVEL and would_be_seen


def _samples(batch: Trajectories, d: int, bound: float) -> _Samples:
    batch = batch.only(batch.noisy)
    x, y, live = batch.transitions(d)
    noise = (batch.actions - batch.action_means).transpose(0, 1)
    clipped = (batch.actions.abs() >= bound).any(dim=-1).T

    def delayed(part: Tensor, back: int) -> Tensor:
        return torch.cat([torch.zeros_like(part[:back]), part])[: len(part)]

    kept = live > 0
    for back in range(ACTIONS):
        kept = kept & ~delayed(clipped, back)
    counts = kept.sum(dim=1).clamp_min(1)[:, None, None]

    def centred(part: Tensor) -> Tensor:
        part = part * kept.unsqueeze(-1)
        return (part - part.sum(dim=1, keepdim=True) / counts)[kept]

    return _Samples(
        centred(x[..., : batch.z.shape[-1]]),
        torch.stack([centred(delayed(noise, back)) for back in range(ACTIONS)]),
        centred(y),
        int(kept.sum() - kept.any(dim=1).sum()),
    )


def _joined(parts: Sequence[_Samples]) -> _Samples:
    """Samples of all batches, or some of them where there are more than it takes."""
    total = sum(len(part.y) for part in parts)
    some = slice(None, None, max(1, -(-total // JUDGED)))
    y = torch.cat([part.y for part in parts])[some]
    return _Samples(
        torch.cat([part.z for part in parts])[some],
        torch.cat([part.noise for part in parts], dim=1)[:, some],
        y,
        sum(part.free for part in parts) * len(y) // max(total, 1),
    )


def _unexplained(y: Float[Tensor, "n k"], x: Float[Tensor, "n p"]) -> Float[Tensor, "n k"]:
    """What a regression on x leaves of y."""
    Q: Tensor = torch.linalg.qr(x).Q
    return y - Q @ (Q.T @ y)


def _factor(covariance: Float[Tensor, "d d"]) -> Float[Tensor, "d d"]:
    """Its Cholesky factor; a floor by its scale lets no latents stop a run here."""
    floor = LEAST_VARIANCE * (1 + covariance.diagonal().mean())
    eye = torch.eye(len(covariance)).to(covariance)
    factor: Tensor = torch.linalg.cholesky(covariance + floor * eye)
    return factor


def is_stuck(batch: Trajectories, d: int, action_cost: float) -> bool:
    """Whether episodes come to rest, and are held, where they cost more than they had on their way.

    In their last tenth they move no more on average, and not one of these steps costs as little as
    an earlier one: by far more than noise makes episodes differ. A policy that is merely not good
    enough stops where it costs least, or its noise takes it there.
    """
    batch = batch.only(batch.noisy & batch.live.all(dim=1))
    episodes, horizon = batch.costs.shape
    steps = max(horizon // 10, LEAST_STEPS)
    if episodes < LEAST_EPISODES or horizon < 2 * steps:
        return False
    way = batch.z[:, steps:, :d] - batch.z[:, :-steps, :d]
    course = way.mean(dim=0)
    apart = (way - course).flatten(0, 1)
    factor = _factor(apart.T @ apart / len(apart))  # latents that are mostly noise count for less
    moved = torch.linalg.solve_triangular(factor, course.T, upper=False).norm(dim=0)
    at_rest = moved[-1] < RESTING * moved.square().mean().sqrt()
    costs = batch.costs - action_cost * batch.actions.square().sum(dim=-1)
    least, most = costs.amin(dim=1), costs.amax(dim=1)
    above = costs[:, -steps:].amin(dim=1) - least
    held = above.mean() > max(HELD * (most - least).mean(), UNMOVED * above.std())
    return bool(at_rest & held)
