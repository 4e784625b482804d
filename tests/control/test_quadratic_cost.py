"""The cost fit: known quadratics are found again, nothing else becomes indefinite."""

import numpy as np
import pytest
import torch

from solar_cli.control.quadratic_cost import explained, fit_quadratic_cost
from solar_cli.control.trajectories import Trajectories
from solar_cli.settings.local import CostFit

N, T, m, a = 30, 6, 3, 2
ALPHA = 0.07
C = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, -0.3], [0.0, -0.3, 0.4]])
c = np.array([0.3, -1.0, 0.5])
b = 4.0


def batch(cost, seed=0, episodes=N, horizon=T, size=m, noise=0.0) -> Trajectories:
    """States and actions, white; costs of ``cost(z, t)`` and of actions."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(episodes, horizon + 1, size))
    actions = rng.normal(size=(episodes, horizon, a))
    costs = np.stack([cost(z[:, t], t) for t in range(horizon)], axis=1)
    costs += ALPHA * np.square(actions).sum(axis=-1) + noise * rng.normal(size=costs.shape)
    live = np.ones(costs.shape, np.bool_)
    return Trajectories(*map(torch.as_tensor, (z, actions, actions, costs, live)))


def quadratic(z, t=0, C=C, c=c, b=b):
    return 0.5 * np.einsum("ni,ij,nj->n", z, C, z) + z @ c + b


def fit(states, features=m, alpha=ALPHA, **settings):
    return fit_quadratic_cost(states, alpha, CostFit.model_validate(settings), features)


def predicted(model, states):
    """Costs (N, T) of the model, as control reads it."""
    x = np.concatenate([states.z[:, :-1].numpy(), states.actions.numpy()], axis=-1)
    second = np.einsum("nti,tij,ntj->nt", x, model.C[:-1].numpy(), x)
    return 0.5 * second + np.einsum("nti,ti->nt", x, model.c[:-1].numpy()) + model.b[:-1].numpy()


def r2(model, states):
    costs = states.costs.numpy()
    return (
        1
        - np.square(predicted(model, states) - costs).sum() / np.square(costs - costs.mean()).sum()
    )


# What is known is found


@pytest.mark.parametrize("per_time", ["never", "chosen"])
def test_a_known_quadratic_is_recovered(per_time):
    found = fit(batch(quadratic), per_time=per_time)
    assert found.r2 > 0.999
    assert r2(found.model, batch(quadratic, seed=1)) > 0.999
    for t in range(T):
        # L-BFGS stops at a squared error of some 1e-7 of the costs' variance.
        np.testing.assert_allclose(found.model.C[t, :m, :m], C, atol=0.02)
        np.testing.assert_allclose(found.model.c[t, :m], c, atol=0.02)
        np.testing.assert_allclose(found.model.b[t], b, atol=0.02)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_units_of_cost_do_not_matter(scale, offset):
    states = batch(quadratic)
    pure = states._replace(costs=states.costs - ALPHA * states.actions.square().sum(dim=-1))
    one = fit(pure, alpha=0.0, per_time="never")
    other = fit(pure._replace(costs=scale * (pure.costs + offset)), alpha=0.0, per_time="never")
    # Rounding steers the line search, so the fits agree as far as both have converged.
    np.testing.assert_allclose(other.model.C / scale, one.model.C, atol=0.02)
    np.testing.assert_allclose(other.model.c / scale, one.model.c, atol=0.02)
    np.testing.assert_allclose(other.model.b[0] / scale, one.model.b[0] + offset, atol=0.02)
    assert other.r2 == pytest.approx(one.r2, abs=1e-3)


def test_the_actions_part_is_known_exactly():
    found = fit(batch(lambda z, t: np.sin(3 * z[:, 0])))
    expected = np.zeros((T, m + a, a))
    expected[:, m:] = 2 * ALPHA * np.eye(a)
    np.testing.assert_array_equal(found.model.C[:-1, :, m:], expected)
    np.testing.assert_array_equal(found.model.C[:-1, m:, :m], np.zeros((T, a, m)))
    np.testing.assert_array_equal(found.model.c[:, m:], np.zeros((T + 1, a)))


def test_the_last_state_costs_the_last_fit_times_its_weight():
    found = fit(batch(quadratic), terminal=2.5).model
    torch.testing.assert_close(found.C[-1, :m, :m], 2.5 * found.C[-2, :m, :m])
    torch.testing.assert_close(found.c[-1, :m], 2.5 * found.c[-2, :m])
    torch.testing.assert_close(found.b[-1], 2.5 * found.b[-2])
    assert found.C[-1, m:].abs().max() == 0  # no action is taken there


def test_only_the_features_cost_anything():
    states = batch(lambda z, t: quadratic(z[:, :m]), size=m + 2)
    found = fit(states)
    assert found.r2 > 0.999
    assert found.model.C.shape == (T + 1, m + 2 + a, m + 2 + a)
    assert found.model.C[:, m : m + 2].abs().max() == 0
    assert found.model.c[:, m : m + 2].abs().max() == 0


# What is fitted is positive definite


@pytest.mark.parametrize(
    "cost",
    [
        lambda z, t: -np.square(z).sum(axis=1),
        lambda z, t: z[:, 0] * z[:, 1],
        lambda z, t: z[:, 0],
        lambda z, t: np.cos(5 * z[:, 0] + t),
        lambda z, t: np.abs(z).sum(axis=1),
        lambda z, t: np.full(len(z), 3.0),
    ],
    ids=["concave", "saddle", "linear", "wave", "edges", "constant"],
)
def test_curvature_is_never_negative(cost):
    model = fit(batch(cost, episodes=12)).model
    assert all(bool(torch.isfinite(part).all()) for part in model)
    assert float(torch.linalg.eigvalsh(model.C).min()) > -1e-12
    torch.testing.assert_close(model.C, model.C.mT, rtol=1e-12, atol=1e-12)


def test_curvature_is_never_negative_on_the_way_down_either():
    model = fit(batch(lambda z, t: z[:, 0] * z[:, 1]), optimiser="sgd", per_time="never").model
    assert float(torch.linalg.eigvalsh(model.C).min()) > -1e-12


def test_a_saddle_is_fitted_no_worse_than_by_its_mean():
    # Of z0 z1, nothing positive definite explains more than a little.
    assert fit(batch(lambda z, t: z[:, 0] * z[:, 1])).r2 > -0.2


# How good it is


def test_r2_is_that_of_episodes_left_out():
    """Every fifth episode judges: noise there, and nowhere else, is what cannot be explained."""
    states = batch(quadratic)
    judge = np.arange(N) % 5 == 4
    noise = np.where(judge[:, None], np.random.default_rng(3).normal(size=(N, T)), 0.0)
    noisy = states._replace(costs=states.costs + torch.as_tensor(3.0 * noise))
    known = noisy.costs.numpy() - ALPHA * np.square(noisy.actions.numpy()).sum(axis=-1)
    truth = np.stack([quadratic(states.z[:, t].numpy()) for t in range(T)], axis=1)[judge]
    known = known[judge]
    expected = 1 - np.square(known - truth).sum() / np.square(known - known.mean()).sum()
    assert 0.1 < expected < 0.6
    assert fit(noisy, per_time="never").r2 == pytest.approx(expected, abs=0.01)


def test_r2_on_other_episodes_is_that_of_the_models_predictions():
    model, others = fit(batch(quadratic)).model, batch(lambda z, t: z[:, 0] ** 3, seed=9)
    assert explained(model, others) == pytest.approx(r2(model, others), rel=1e-12)
    assert explained(model, batch(quadratic, seed=9)) > 0.999


def varying(z, t):
    """The minimum moves, and the curvature with it."""
    return quadratic(z, C=(1 + t) * C / 3, c=c * (t - 2), b=b)


def test_a_cost_that_varies_is_fitted_per_time_step():
    states = batch(varying, episodes=80)
    each = fit(states, width=0.3)
    assert each.per_time
    assert each.r2 > 0.98
    assert each.r2 > fit(states, per_time="never").r2 + 0.1
    assert r2(each.model, batch(varying, seed=1)) > 0.98


def test_a_cost_that_does_not_vary_is_fitted_once():
    """Few noisy episodes: a fit a time step explains their noise, and held-out ones tell."""
    states = batch(quadratic, episodes=10, noise=1.5)
    found = fit(states, width=0.3)
    assert not found.per_time
    for t in range(1, T):
        torch.testing.assert_close(found.model.C[t], found.model.C[0], rtol=0, atol=0)


def test_per_time_can_be_switched_off():
    found = fit(batch(varying, episodes=40), width=0.3, per_time="never")
    assert not found.per_time
    torch.testing.assert_close(found.model.c[1], found.model.c[0], rtol=0, atol=0)


def test_a_fit_per_time_step_reaches_to_its_neighbours():
    """The wider it reaches, the less does one time step differ from the next."""
    states = batch(varying, episodes=80)
    spread = [
        float(fit(states, width=width).model.c[:-1, :m].diff(dim=0).norm()) for width in (0.3, 2.0)
    ]
    assert spread[1] < 0.7 * spread[0]


def test_stochastic_gradients_descend_too():
    assert fit(batch(quadratic), optimiser="sgd", per_time="never").r2 > 0.95


@pytest.mark.parametrize("episodes", [2, 4])
def test_a_few_episodes_are_enough_to_judge(episodes):
    states = batch(quadratic, episodes=episodes, horizon=30)
    assert fit(states, per_time="never").r2 > 0.99


def test_a_constant_cost_is_explained():
    states = batch(lambda z, t: np.full(len(z), 3.0))
    pure = states._replace(costs=torch.full((N, T), 3.0).double())
    assert fit(pure, alpha=0.0).r2 > 0.99


@pytest.mark.parametrize("seed", range(6))
def test_a_good_representation_is_not_taken_for_a_dead_one(seed):
    """Latents of a moving point and a goal miss the truth by a tenth of a std: half of the costs'
    variance is what health asks, and a fit on 51 episodes explains far more on the other 9."""
    rng = np.random.default_rng(seed)
    place, goal = rng.uniform(-1, 1, (2, 60, 1, 2))
    place = place + np.cumsum(0.1 * rng.normal(size=(60, 51, 2)), axis=1)
    truth = np.concatenate([place, np.broadcast_to(goal, place.shape)], axis=-1)
    z = (truth - truth.mean(axis=(0, 1))) / truth.std(axis=(0, 1))
    z = z + 0.1 * rng.normal(size=z.shape)
    costs = np.square(place - goal).sum(axis=-1)[:, :-1]
    actions = np.zeros((60, 50, 2))
    learned, judge = (
        Trajectories(
            *(torch.as_tensor(part[rows]) for part in (z, actions, actions, costs, costs > -1))
        )
        for rows in (slice(51), slice(51, None))
    )
    assert explained(fit(learned, features=4, per_time="never").model, judge) > 0.8


def test_a_fit_per_time_step_is_a_weighted_regression_on_monomials():
    """Where that is positive definite; samples of neighbouring steps weigh as a Gaussian."""
    width, states = 1.3, batch(varying, episodes=200, noise=0.3)
    z = states.z[:, :-1].numpy()
    known = states.costs.numpy() - ALPHA * np.square(states.actions.numpy()).sum(axis=-1)
    rows, columns = np.tril_indices(m)
    monomials = np.concatenate([z[..., rows] * z[..., columns], z, np.ones((200, T, 1))], axis=-1)
    found = fit(states, width=width)
    assert found.per_time
    for t in range(T):
        distance = np.abs(np.arange(T) - t)
        root = np.exp(-0.25 * np.square(distance / width)) * (distance <= 3)
        left = (root[:, None] * monomials).reshape(-1, monomials.shape[-1])
        w = np.linalg.lstsq(left, (root * known).ravel(), rcond=None)[0]
        half = np.zeros((m, m))
        half[rows, columns] = w[: len(rows)]
        expected = half + half.T
        assert np.linalg.eigvalsh(expected).min() > 0.05
        # The pull towards the one fit of all time steps moves it by a little.
        np.testing.assert_allclose(found.model.C[t, :m, :m], expected, atol=0.04)
        np.testing.assert_allclose(found.model.c[t, :m], w[len(rows) : -1], atol=0.04)
        np.testing.assert_allclose(found.model.b[t], w[-1], atol=0.04)
