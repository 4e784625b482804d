"""What was tried is built upon, or taken back, by collected costs and their standard errors."""

import io
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from solar_cli.control.linear_gaussian import (
    LinearDynamics,
    LinearGaussianPolicy,
    QuadraticCost,
    initial_policy,
)
from solar_cli.control.step_size import StepSize
from solar_cli.control.trust_region import Anchor, TrustRegion, promised_fall
from solar_cli.episodes import Batch, Episodes

GAINS = initial_policy(3, 2, 1, 0.5)


def tried(iteration: int, cost: float, error: float = 1.0) -> Anchor:
    return Anchor((Batch(iteration, 0),), GAINS, cost, error)


def batch(iteration: int, call: int, costs: np.ndarray) -> Episodes:
    """Episodes of these costs (N, T)."""
    actions = np.zeros((*costs.shape, 1))
    frames = np.zeros((len(costs), costs.shape[1] + 1, 1))
    return Episodes(frames, actions, actions, costs, batch=Batch(iteration, call))


def region(**changes) -> TrustRegion:
    return TrustRegion(StepSize(low=0.3, high=2.0), **changes)


def after(*costs: float, tolerance=1.0, error=1.0) -> TrustRegion:
    """Iterations of these costs; every update promised what would keep the step."""
    state = region()
    for iteration, cost in enumerate(costs, 1):
        state = state.judged(tried(iteration, cost, error), tolerance)
    return state


def test_a_batch_is_judged_by_the_sums_of_its_episodes():
    costs = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 9.0]])
    anchor = Anchor.of(GAINS, batch(4, 0, costs))
    assert anchor.iteration == 4
    assert anchor.gains is GAINS
    assert anchor.cost == pytest.approx((3 + 7 + 14) / 3)
    # Deviations -5, -1, 6: variance 62 / 2, over 3 episodes.
    assert anchor.error == pytest.approx(math.sqrt(31 / 3))


def test_one_episode_has_no_error():
    assert Anchor.of(GAINS, batch(1, 0, np.ones((1, 2)))) == tried(1, 2.0, 0.0)


def test_the_first_batch_is_the_best_and_the_one_to_build_upon():
    state = after(10.0)
    assert state.best == state.current == tried(1, 10.0)
    assert not state.rejections
    assert math.isnan(state.kept)
    assert state.step.multiplier == 1.0


def test_a_better_batch_is_the_new_best():
    state = after(10.0, 8.0)
    assert state.best == state.current == tried(2, 8.0)
    assert state.kept == 2.0
    assert not state.rejections


def test_a_batch_that_is_worse_by_its_noise_is_built_upon_but_not_the_best():
    # The margin of two errors of 1 is sqrt 2.
    state = after(10.0, 11.4)
    assert state.current == tried(2, 11.4)
    assert state.best == tried(1, 10.0)
    assert state.kept == pytest.approx(-1.4)
    assert not state.rejections


def test_a_batch_that_is_worse_by_more_is_taken_back():
    state = after(10.0, 11.5)
    assert state.current == state.best == tried(1, 10.0)
    assert state.rejections
    assert state.kept == pytest.approx(-1.5)
    assert state.step.multiplier == pytest.approx(0.4)


def test_further_episodes_belong_to_what_is_built_upon():
    state = after(10.0, 20.0).gathered(batch(2, 1, np.ones((2, 2))))  # the second was taken back
    assert state.built_upon.batches == state.best.batches == (Batch(1, 0), Batch(2, 1))
    assert state.built_upon.iteration == 1
    state = after(10.0, 11.4).gathered(batch(2, 1, np.ones((2, 2))))  # built upon, but not the best
    assert state.built_upon.batches == (Batch(2, 0), Batch(2, 1))
    assert state.best.batches == (Batch(1, 0),)


@pytest.mark.parametrize(("tolerance", "taken_back"), [(0.5, True), (2.0, False), ("never", False)])
def test_the_tolerance_is_in_standard_errors(tolerance, taken_back):
    assert after(10.0, 11.5, tolerance=tolerance).rejections == taken_back


def test_next_to_nothing_of_what_was_gained_is_tolerated_where_there_is_no_noise():
    assert not after(100.0, 60.0, 60.7, error=1e-3).rejections
    assert after(100.0, 60.0, 60.9, error=1e-3).rejections
    assert after(100.0, 60.0, 60.7, 61.4, error=1e-3).rejections  # of the best, not of the last


def test_each_rejection_in_a_row_widens_the_margin():
    """One of sqrt 2, then of two and three of it; what is built upon narrows it again."""
    assert after(10.0, 15.0, 12.9).rejections == 2
    assert after(10.0, 15.0, 12.8).rejections == 0
    assert after(10.0, 15.0, 15.0, 14.3).rejections == 3
    assert after(10.0, 15.0, 15.0, 14.2).current == tried(4, 14.2)
    assert after(10.0, 15.0, 12.8, 11.5).rejections == 1
    # Where there is no noise, next to nothing widens as well.
    assert after(100.0, 60.0, 60.9, 61.7, error=1e-3).rejections == 2
    assert after(100.0, 60.0, 60.9, 61.5, error=1e-3).rejections == 0


def test_episodes_of_policies_that_were_taken_back_in_a_row_are_known():
    state = after(10.0, 9.0, 15.0, 15.0)
    assert state.rejected == (*tried(3, 15.0).batches, *tried(4, 15.0).batches)
    assert after(10.0, 9.0, 15.0, 8.0).rejected == ()


def test_without_rejection_anything_is_built_upon():
    state = after(10.0, 1e6, tolerance="never")
    assert state.current == tried(2, 1e6)
    assert state.best == tried(1, 10.0)


def test_small_steps_downhill_cannot_lead_away_from_the_best():
    """Each batch is within the noise of the one before, but not of the best."""
    state = after(10.0, 11.0, 12.0)
    assert state.rejections
    assert state.current == tried(1, 10.0)


def test_what_follows_a_rejection_is_compared_with_what_it_was_built_upon():
    state = after(10.0, 20.0, 9.0)
    assert state.kept == 1.0
    assert state.best == state.current == tried(3, 9.0)
    assert not state.rejections


def test_the_best_never_gets_worse_nor_is_it_replaced_by_an_equal():
    rng = np.random.default_rng(0)
    costs = rng.normal(10.0, 3.0, 60)
    state, least = region(), math.inf
    for iteration, cost in enumerate(costs, 1):
        state = state.judged(tried(iteration, float(cost)), 1.0)
        least = min(least, cost)
        assert state.best.cost == least
    assert state.best.iteration == int(np.argmin(costs)) + 1
    again = state.judged(tried(99, state.best.cost), 1.0)
    assert again.best.iteration == state.best.iteration


def test_the_step_follows_what_was_promised_and_kept():
    promised = region(promised=4.0, first=10.0, best=tried(1, 10.0), current=tried(1, 10.0))
    assert promised.judged(tried(2, 6.0), 1.0).step.multiplier == 2.0
    assert promised.judged(tried(2, 7.5), 1.0).step.multiplier == pytest.approx(4 / 3)
    assert promised.judged(tried(2, 8.0), 1.0).step.multiplier == 1.0
    assert promised.judged(tried(2, 99.0), 1.0).step.multiplier == pytest.approx(0.4)


@pytest.mark.parametrize("tolerance", [0.5, 1.0, "never"])
def test_the_step_shrinks_by_what_neither_batch_s_noise_explains(tolerance):
    """Errors of .3 and .4, so .5 together: 4 / (2 x (3.9 - .5)) of the step."""
    promised = region(promised=4.0, first=10.0, best=tried(1, 10.0), current=tried(1, 10.0, 0.3))
    judged = promised.judged(tried(2, 9.9, 0.4), tolerance)
    assert judged.step.multiplier == pytest.approx(4 / 6.8)
    assert promised.judged(tried(2, 9.9, 9.0), 1.0).step.multiplier == 1.0


def test_a_promise_that_is_small_beside_what_was_gained_makes_no_step_larger():
    late = region(promised=4.0, first=100.0, best=tried(1, 10.0), current=tried(1, 10.0))
    assert late.judged(tried(2, 6.0), 1.0).step.multiplier == 1.0
    smaller = late.judged(tried(2, 9.9), 1.0).step.multiplier
    assert smaller == pytest.approx(4 / (2 * (3.9 - math.sqrt(2))))
    early = replace(late, first=80.0)
    assert early.judged(tried(2, 6.0), 1.0).step.multiplier == 2.0


def test_metrics_say_what_happened():
    state = region(promised=4.0, best=tried(1, 10.0), current=tried(1, 10.0))
    assert state.judged(tried(2, 99.0), 1.0).metrics() == {
        "predicted_improvement": 4.0,
        "actual_improvement": -89.0,
        "rejected": 1.0,
        "step_multiplier": 0.4,
    }


def test_nothing_is_said_of_an_improvement_that_nobody_promised():
    assert after(10.0).metrics() == {"rejected": 0.0, "step_multiplier": 1.0}


def test_a_promise_is_the_fall_of_what_is_collected():
    """Expected costs of t < T by a loop over moments; the weight of the last state is no cost."""
    rng = np.random.default_rng(0)
    d, a, horizon = 2, 1, 4

    def policy():
        root = rng.normal(size=(horizon, a, a))
        S = root @ root.swapaxes(1, 2) + 0.1
        return rng.normal(size=(horizon, a, d)), rng.normal(size=(horizon, a)), S

    F, f = 0.5 * rng.normal(size=(horizon, d, d + a)), rng.normal(size=(horizon, d))
    Sigma, mu0, Sigma0 = np.tile(0.1 * np.eye(d), (horizon, 1, 1)), rng.normal(size=d), np.eye(d)
    root = rng.normal(size=(horizon + 1, d + a, d + a))
    C, c = root @ root.swapaxes(1, 2), rng.normal(size=(horizon + 1, d + a))
    C[-1] *= 1e3
    b = rng.normal(size=horizon + 1)

    def collected(K, k, S):
        total, mean, covariance = 0.0, mu0, Sigma0
        for t in range(horizon):
            lift = np.vstack([np.eye(d), K[t]])
            x = lift @ mean + np.concatenate([np.zeros(d), k[t]])
            spread = lift @ covariance @ lift.T
            spread[d:, d:] += S[t]
            total += 0.5 * (x @ C[t] @ x + np.trace(C[t] @ spread)) + c[t] @ x + b[t]
            mean, covariance = F[t] @ x + f[t], F[t] @ spread @ F[t].T + Sigma[t]
        return total

    before, now = policy(), policy()
    found = promised_fall(
        LinearGaussianPolicy(*map(torch.as_tensor, before)),
        LinearGaussianPolicy(*map(torch.as_tensor, now)),
        LinearDynamics(*map(torch.as_tensor, (F, f, Sigma, mu0, Sigma0))),
        QuadraticCost(*map(torch.as_tensor, (C, c, b))),
        noisy=True,
    )
    assert found == pytest.approx(collected(*before) - collected(*now), rel=1e-9)


def test_an_update_is_handed_over_untried_for_a_fifth_of_what_was_gained():
    state = after(100.0, 80.0, 60.0, 60.5)
    assert state.first == 100.0
    assert state.best.cost == 60.0
    assert state.trusts(8.1)
    assert not state.trusts(7.9)
    assert not state.trusts(math.nan)
    rejected = after(100.0, 80.0, 60.0, 70.0)  # the model has just been wrong
    assert not rejected.trusts(40.0)
    assert after(100.0, 80.0, 60.0, 70.0, 55.0).trusts(40.0)
    assert after(100.0).trusts(0.0)  # before anything was gained


@pytest.mark.parametrize("costs", [(), (10.0,), (10.0, 11.0), (10.0, 20.0)])
def test_a_saved_trust_region_goes_on_as_it_would_have(costs):
    state = after(*costs)
    if costs:
        state = state.gathered(batch(len(costs), 1, np.ones((2, 2))))
    buffer = io.BytesIO()
    torch.save(state.state_dict(), buffer)
    buffer.seek(0)
    restored = region().restored(torch.load(buffer, weights_only=True))
    for cost in (9.0, 12.0, 30.0):
        left, right = (s.judged(tried(7, cost), 1.0) for s in (state, restored))
        for name in ("step", "kept", "rejected", "promised", "first"):
            assert str(getattr(left, name)) == str(getattr(right, name)), name
        for name in ("best", "current"):
            one, other = getattr(left, name), getattr(right, name)
            for field in ("batches", "iteration", "cost", "error"):
                assert getattr(one, field) == getattr(other, field)
            assert isinstance(other.gains, LinearGaussianPolicy)
            assert all(torch.equal(*pair) for pair in zip(one.gains, other.gains, strict=True))
