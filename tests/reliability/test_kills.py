"""Kills and stops at random moments while two cells are computed."""

import random
from collections.abc import Callable

from disturbed import Matrix, Undisturbed

KILLS = 8
STOPS = 4


def test_kills_at_random_moments_change_no_bit(
    matrix: Callable[[int], Matrix], undisturbed: Undisturbed
) -> None:
    dice = random.Random(4)
    kills = 0
    while kills < KILLS:
        run = matrix(2)
        for who in dice.sample(("workers", "scheduler", "all"), 3):
            run.die_after(dice.uniform(0.0, 0.7) * undisturbed.seconds, who)
        assert all(result["finished"] for result in run.finish())
        assert run.fingerprints() == undisturbed.fingerprints
        kills += run.kills


def test_stops_at_random_moments_change_no_bit(
    matrix: Callable[[int], Matrix], undisturbed: Undisturbed
) -> None:
    dice = random.Random(5)
    stops = 0
    while stops < STOPS:
        run = matrix(2)
        # Each goes on where the one before has stopped.
        stops += sum(run.stop_after(dice.uniform(0.0, 0.5) * undisturbed.seconds) for _ in range(2))
        assert all(result["finished"] for result in run.finish())
        assert run.fingerprints() == undisturbed.fingerprints
