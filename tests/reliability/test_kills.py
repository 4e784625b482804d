"""Kills at random moments, of workers, schedulers or all of them, while two cells are computed."""

import random
from collections.abc import Callable

import pytest
from disturbed import Matrix, Undisturbed

pytestmark = pytest.mark.timeout(900)  # many processes, each of which imports torch
KILLS = 8


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
