"""The step-size rule on hand-worked cases."""

from __future__ import annotations

import math

import pytest

from solar_cli.control.step_size import StepSize


def step(multiplier: float = 1.0) -> StepSize:
    return StepSize(low=0.3, high=2.0, multiplier=multiplier)


@pytest.mark.parametrize(
    ("predicted", "actual", "multiplier"),
    [
        (10.0, 5.0, 1.0),  # half of the promise: keep
        (10.0, 10.0, 2.0),  # all of it: double
        (10.0, 30.0, 2.0),  # more than promised: at most double
        (10.0, 6.0, 1.25),  # 10 / (2 x 4)
        (10.0, 0.0, 0.5),
        (10.0, -500.0, 0.5),  # a rise: at most halve
        (1e-9, 5e-10, 1.0),  # no unit of cost is built in
        (-1.0, 5.0, 1.0),  # no improvement promised: nothing learned
        (math.nan, 5.0, 1.0),
        (1.0, math.inf, 1.0),
        (math.inf, 5.0, 1.0),
    ],
)
def test_factor_follows_the_share_of_the_prediction_that_came_true(predicted, actual, multiplier):
    assert step().after(predicted, actual, error=0.0).multiplier == pytest.approx(multiplier)


@pytest.mark.parametrize(
    ("actual", "error", "multiplier"),
    [
        (0.0, 3.0, 10 / 14),  # 10 / (2 x 7): what is beyond the noise
        (0.0, 5.0, 1.0),
        (0.0, 9.0, 1.0),  # noise is no reason to go further
        (4.5, 0.3, 10 / 10.4),  # however little smaller
        (-10.0, 2.0, 0.5),
        (5.0, 2.0, 1.0),
        (6.0, 9.0, 1.25),  # nor does it change a step that grows
        (6.0, 0.0, 1.25),
        (7.5, 9.0, 2.0),
    ],
)
def test_only_what_noise_does_not_explain_makes_a_step_smaller(actual, error, multiplier):
    assert step().after(10.0, actual, error).multiplier == pytest.approx(multiplier)


def test_step_maximises_the_gain_when_the_model_errs_by_the_square_of_the_step():
    p, e, m = 8.0, 2.5, 1.3
    after = step(m).after(predicted=p * m, actual=p * m - e * m * m, error=0.0)
    gains = {x / 1000: p * x / 1000 - e * (x / 1000) ** 2 for x in range(300, 2001)}
    assert after.multiplier == pytest.approx(max(gains, key=gains.__getitem__), abs=1e-3)


def test_multiplier_stays_within_its_bounds():
    adapted = step()
    for _ in range(5):
        adapted = adapted.after(1.0, 1.0, error=0.0)
    assert adapted.multiplier == 2.0
    for _ in range(5):
        adapted = adapted.after_rejection()
    assert adapted.multiplier == 0.3


def test_rejection_takes_two_fifths_of_the_step():
    assert step(1.5).after_rejection().multiplier == pytest.approx(0.6)
