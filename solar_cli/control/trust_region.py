"""Which episodes an update starts from: the newest ones, or the best so far when those are worse.

Costs of episodes are noisy, so a batch counts as worse only by its standard error, and makes a step
smaller only by what that does not explain. Judged by collected episodes alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import torch

from solar_cli.control.linear_gaussian import (
    LinearDynamics,
    LinearGaussianPolicy,
    QuadraticCost,
    expected_cost,
)
from solar_cli.control.step_size import StepSize
from solar_cli.episodes import Batch, Episodes

LEAST_PROMISE = 0.2
"""Share of what has been gained so far below which an update is tried before it is handed over: of
those that promised a twentieth to a fifth 29 of 69 made things worse, and the others gained little;
of those that promised a fifth or more, up to all, 11 of 62, and they gained much (car, reacher and
Sawyer; counted when a promise still had the noise's part in it)"""

LEFT_TO_GAIN = 0.05
"""Share of what has been gained so far that an update must promise for steps to grow"""

NEXT_TO_NOTHING = 0.02
"""Share of what has been gained so far by which a batch may always be worse than the best: where
episodes hardly differ, their noise is so small that nothing would ever be built upon again."""


class Anchor(NamedTuple):
    """A policy that was tried, where its episodes are, and what they cost."""

    batches: tuple[Batch, ...]
    """oldest first"""
    gains: LinearGaussianPolicy
    cost: float
    """mean of the sum over an episode"""
    error: float
    """its standard error"""

    @staticmethod
    def of(gains: LinearGaussianPolicy, episodes: Episodes) -> Anchor:
        """Judge a policy by the cost of a collected batch of its episodes."""
        assert episodes.batch is not None
        totals = episodes.costs.sum(axis=1)
        error = totals.std(ddof=1) / math.sqrt(len(totals)) if len(totals) > 1 else 0.0
        return Anchor((episodes.batch,), gains, float(totals.mean()), float(error))

    @property
    def iteration(self) -> int:
        """The first that collected its episodes."""
        return self.batches[0].iteration

    def with_more(self, episodes: Episodes) -> Anchor:
        """The same policy with a further batch."""
        assert episodes.batch is not None
        return self._replace(batches=(*self.batches, episodes.batch))


@dataclass(frozen=True)
class TrustRegion:
    """The best policy so far, the one to build upon, and how far to step."""

    step: StepSize
    best: Anchor | None = None
    current: Anchor | None = None
    promised: float = math.nan
    """fall of the cost that the last update predicted"""
    kept: float = math.nan
    """fall of the cost that was measured for it"""
    rejected: tuple[Batch, ...] = ()
    """of the last policies in a row that were worse than the best and taken back, one of each"""
    first: float = math.nan
    """cost of the first policy, which knows nothing"""

    def judged(self, tried: Anchor, tolerance: float | Literal["never"]) -> TrustRegion:
        """Build upon what was just tried, or go back to the best; the step is adapted."""
        if self.best is None or self.current is None:
            return replace(self, best=tried, current=tried, first=tried.cost)
        kept = self.current.cost - tried.cost
        if tolerance != "never" and tried.cost > self.best.cost + self._margin(tried, tolerance):
            step = self.step.after_rejection()
            rejected = (*self.rejected, *tried.batches)
            return replace(self, current=self.best, step=step, kept=kept, rejected=rejected)
        error = math.hypot(tried.error, self.current.error)
        step = self.step.after(self.promised, kept, error)
        if self.promised < self._share(LEFT_TO_GAIN):
            step = min(step, self.step, key=lambda step: step.multiplier)
        return replace(
            self,
            step=step,
            best=tried if tried.cost < self.best.cost else self.best,
            current=tried,
            kept=kept,
            rejected=(),
        )

    def _margin(self, tried: Anchor, tolerance: float) -> float:
        """By how much a batch may be worse than the best: its noise, or next to nothing.

        The more batches in a row were worse, the likelier the best one was just lucky: each widens
        the margin, or a lucky batch would be built upon for ever (car, seed 102: five in a row).
        """
        assert self.best is not None
        noise = tolerance * math.hypot(tried.error, self.best.error)
        return (1 + self.rejections) * max(noise, self._share(NEXT_TO_NOTHING))

    @property
    def rejections(self) -> int:
        """Policies in a row that were taken back."""
        return len(self.rejected)

    @property
    def built_upon(self) -> Anchor:
        """What the next update starts from; there is none before a first policy was judged."""
        assert self.current is not None
        return self.current

    def gathered(self, episodes: Episodes) -> TrustRegion:
        """With a further batch of the policy that is built upon."""
        current = self.built_upon.with_more(episodes)
        same = self.best is not None and self.best.batches == self.built_upon.batches
        best = current if same else self.best
        return replace(self, current=current, best=best)

    def trusts(self, promised: float) -> bool:
        """Whether an update that promises this fall of the cost may be handed over untried.

        Not after one that was taken back: what the model promised of that was not true either.
        """
        return self.rejections == 0 and promised >= self._share(LEAST_PROMISE)

    def _share(self, part: float) -> float:
        """That part of the fall of the cost since the first policy."""
        assert self.best is not None
        return part * (self.first - self.best.cost)

    def metrics(self) -> dict[str, float]:
        """What the last update promised and gave, once there was one, and what follows."""
        falls = {"predicted_improvement": self.promised, "actual_improvement": self.kept}
        return {
            **(falls if math.isfinite(self.promised) else {}),
            "rejected": float(self.rejections > 0),
            "step_multiplier": self.step.multiplier,
        }

    def state_dict(self) -> dict[str, Any]:
        """Plain data and tensors."""
        return {
            "multiplier": self.step.multiplier,
            "best": _plain(self.best),
            "current": _plain(self.current),
            "promised": self.promised,
            "first": self.first,
            "rejected": [tuple(batch) for batch in self.rejected],
        }

    def restored(self, state: dict[str, Any]) -> TrustRegion:
        """This trust region's bounds with a saved state."""
        return replace(
            self,
            step=replace(self.step, multiplier=state["multiplier"]),
            best=_anchor(state["best"]),
            current=_anchor(state["current"]),
            promised=state["promised"],
            first=state["first"],
            # Checkpoints from before they were learned from have none.
            rejected=tuple(Batch(*batch) for batch in state.get("rejected", ())),
        )


def promised_fall(
    previous: LinearGaussianPolicy,
    policy: LinearGaussianPolicy,
    dynamics: LinearDynamics,
    cost: QuadraticCost,
    *,
    noisy: bool,
) -> float:
    """By how much the model says that the cost of t = 0..T-1 falls, with or without action noise.

    Without the weight of the last state, whose cost is never observed: what is collected is judged
    by the same sum.
    """

    def costs(gains: LinearGaussianPolicy) -> float:
        if not noisy:
            gains = gains._replace(S=torch.zeros_like(gains.S))
        return float(expected_cost(gains, dynamics, cost)[..., :-1].sum())

    return costs(previous) - costs(policy)


def _plain(anchor: Anchor | None) -> dict[str, Any] | None:
    if anchor is None:
        return None
    return {
        **anchor._asdict(),
        "batches": [tuple(batch) for batch in anchor.batches],
        "gains": [gain.clone() for gain in anchor.gains],
    }


def _anchor(state: dict[str, Any] | None) -> Anchor | None:
    if state is None:
        return None
    batches = tuple(Batch(*batch) for batch in state["batches"])
    gains = LinearGaussianPolicy(*state["gains"])
    return Anchor(**{**state, "batches": batches, "gains": gains})
