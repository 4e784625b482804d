"""How far the next policy update may go, from what the last one promised and what it gave."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

# A batch's cost is a noisy measurement: one update may at most double or halve the step.
LEAST_FACTOR, LARGEST_FACTOR = 0.5, 2.0
REJECTION_FACTOR = 0.4


@dataclass(frozen=True)
class StepSize:
    """Multiplier of the KL step (nats a time step), kept within [low, high]."""

    low: float
    high: float
    multiplier: float = 1.0

    def after(self, predicted: float, actual: float, error: float) -> StepSize:
        """The step after an update that was predicted to lower the cost by ``predicted``.

        ``actual`` is the measured fall, ``error`` its standard error. If what the model misses
        grows as the square of the step m (gain = p m - e m^2), the best step is
        m p / (2 (p - actual)): gps' rule. Half of what was predicted keeps the step, three quarters
        or more double it, nothing or a rise halve it. A prediction that is no improvement, or not
        finite, teaches nothing.

        Where that is a smaller step, the fall counts as one standard error larger, as far as keeps
        the step. Bad luck of a few episodes held it at its least otherwise, in each of nine runs on
        Sawyer. Good luck still makes it larger; a step that went too far is taken back.
        """
        if not (predicted > 0 and math.isfinite(predicted) and math.isfinite(actual)):
            return self
        factor = _factor((predicted - actual) / predicted)
        if factor < 1:
            factor = min(_factor((predicted - actual - error) / predicted), 1.0)
        return self._times(factor)

    def after_rejection(self) -> StepSize:
        """The step after an update that was taken back."""
        return self._times(REJECTION_FACTOR)

    def _times(self, factor: float) -> StepSize:
        return replace(self, multiplier=min(max(self.multiplier * factor, self.low), self.high))


def _factor(shortfall: float) -> float:
    """Of the next step, after an update that fell short by this share of its promise."""
    if shortfall <= 1 / (2 * LARGEST_FACTOR):
        return LARGEST_FACTOR
    return max(LEAST_FACTOR, 1 / (2 * shortfall))
