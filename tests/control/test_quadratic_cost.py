"""The cost fit: known quadratics are found again, nothing else becomes indefinite."""

import numpy as np
import pytest
import torch
from predicted_costs import r2

from solar_cli.control import trajectories
from solar_cli.control.quadratic_cost import FOLDS, PULL, fit_quadratic_cost
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


def fit(states, features=m, alpha=ALPHA, older=(), **settings):
    return fit_quadratic_cost(states, older, alpha, CostFit.model_validate(settings), features)


def monomials(states):
    """(N, T, q): z_i z_j for j <= i, z, 1."""
    z = states.z[:, :-1].numpy()
    i, j = np.tril_indices(z.shape[-1])
    return np.concatenate([z[..., i] * z[..., j], z, np.ones((*z.shape[:2], 1))], axis=-1)


def rows(design):
    return design.reshape(-1, design.shape[-1])


def curvature(w):
    """C of the weights of monomials."""
    half = np.zeros((m, m))
    half[np.tril_indices(m)] = w[: m * (m + 1) // 2]
    return half + half.T


# |C|^2 / 2 + |c|^2 in weights of monomials: C_ii = 2 w_ii, and C_ij = w_ij stands in C twice.
PENALTY = np.array([*np.where(np.equal(*np.tril_indices(m)), 2.0, 1.0), *np.ones(m), 0.0])


def standardised(states):
    """Costs (N, T) without the action's part, their mean and std."""
    known = states.costs.numpy() - ALPHA * np.square(states.actions.numpy()).sum(axis=-1)
    mean, scale = known.mean(), known.std(ddof=1)
    return (known - mean) / scale, mean, scale


def regression(design, y, penalty, towards):
    """w of the least mean squared error + penalty (w - towards)^2."""
    left = design.T @ design / len(design) + np.diag(penalty)
    return np.linalg.solve(left, design.T @ y / len(design) + penalty * towards)


def regression_per_time_step(design, y, t, width, shared):
    """Its w: samples of neighbouring steps weigh as a Gaussian, and it is pulled to ``shared``."""
    distance = np.abs(np.arange(T) - t)
    weight = np.exp(-0.5 * np.square(distance / width)) * (distance <= max(1, round(2 * width)))
    root = np.sqrt(weight / weight.sum() * T)
    pull = PULL * np.maximum(PENALTY, 1)
    return regression(rows(root[:, None] * design), (root * y).ravel(), pull, shared)


# What is known is found


@pytest.mark.parametrize("per_time", ["never", "chosen"])
def test_a_known_quadratic_is_recovered(per_time):
    found = fit(batch(quadratic), per_time=per_time)
    assert found.r2 > 0.999
    assert r2(found.model, batch(quadratic, seed=1)) > 0.999
    for t in range(T):
        # The least ridge that is chosen among is 1e-6, and moves what is found by as much.
        np.testing.assert_allclose(found.model.C[t, :m, :m], C, atol=1e-4)
        np.testing.assert_allclose(found.model.c[t, :m], c, atol=1e-4)
        np.testing.assert_allclose(found.model.b[t], b, atol=1e-4)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_units_of_cost_do_not_matter(scale, offset):
    states = batch(quadratic)
    pure = states._replace(costs=states.costs - ALPHA * states.actions.square().sum(dim=-1))
    one = fit(pure, alpha=0.0, per_time="never")
    other = fit(pure._replace(costs=scale * (pure.costs + offset)), alpha=0.0, per_time="never")
    np.testing.assert_allclose(other.model.C / scale, one.model.C, atol=1e-6)
    np.testing.assert_allclose(other.model.c / scale, one.model.c, atol=1e-6)
    np.testing.assert_allclose(other.model.b[0] / scale, one.model.b[0] + offset, atol=1e-6)
    assert other.r2 == pytest.approx(one.r2, abs=1e-9)


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
    """Each fold against ridge regression on the others, whose Hessian here is positive definite."""
    states = batch(quadratic, noise=2.0)
    known = states.costs.numpy() - ALPHA * np.square(states.actions.numpy()).sum(axis=-1)
    design = monomials(states)
    fold = np.arange(N) % FOLDS
    squared = 0.0
    for k in range(FOLDS):
        learned, judge = fold != k, fold == k
        w = np.linalg.lstsq(rows(design[learned]), known[learned].ravel(), rcond=None)[0]
        assert np.linalg.eigvalsh(curvature(w)).min() > 0.05
        squared += np.square(rows(design[judge]) @ w - known[judge].ravel()).sum()
    expected = 1 - squared / np.square(known - known.mean()).sum()
    assert 0.1 < expected < 0.8
    found = fit(states, per_time="never", ridge=(0.0,))
    assert found.r2 == pytest.approx(expected, abs=1e-6)


def test_r2_within_is_of_what_costs_differ_by_at_a_time_step():
    """A cost that only time tells is explained, and what noise adds to it is not."""
    states = batch(lambda z, t: quadratic(z), noise=2.0)
    known = states.costs.numpy() - ALPHA * np.square(states.actions.numpy()).sum(axis=-1)
    design, fold = monomials(states), np.arange(N) % FOLDS
    wrong = np.zeros_like(known)
    for k in range(FOLDS):
        learned, judge = fold != k, fold == k
        w = np.linalg.lstsq(rows(design[learned]), known[learned].ravel(), rcond=None)[0]
        wrong[judge] = design[judge] @ w - known[judge]
    left, total = (np.square(part - part.mean(axis=0)).sum() for part in (wrong, known))
    found = fit(states, per_time="never", ridge=(0.0,))
    assert found.within == pytest.approx(1 - left / total, abs=1e-6)


def varying(z, t):
    """The minimum moves, and the curvature with it."""
    return quadratic(z, C=(1 + t) * C / 3, c=c * (t - 2), b=b)


def test_a_cost_that_varies_is_fitted_per_time_step():
    states = batch(varying, episodes=80)
    each = fit(states, width=0.3)
    assert each.choice.per_time
    assert each.r2 > 0.98
    assert each.r2 > fit(states, per_time="never").r2 + 0.1
    assert r2(each.model, batch(varying, seed=1)) > 0.98


def test_a_cost_that_does_not_vary_is_fitted_once():
    """Few noisy episodes: a fit a time step explains their noise, and held-out ones tell."""
    states = batch(quadratic, episodes=10, noise=1.5)
    found = fit(states, width=0.3)
    assert not found.choice.per_time
    for t in range(1, T):
        torch.testing.assert_close(found.model.C[t], found.model.C[0], rtol=0, atol=0)


def test_per_time_can_be_switched_off():
    found = fit(batch(varying, episodes=40), width=0.3, per_time="never")
    assert not found.choice.per_time
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
    assert r2(fit(learned, features=4, per_time="never").model, judge) > 0.8


def test_a_fit_per_time_step_is_a_weighted_regression_on_monomials():
    """Of standardised costs. Where that is convex, it is what is found."""
    width, states = 1.3, batch(varying, episodes=200, noise=0.3)
    y, mean, scale = standardised(states)
    design = monomials(states)
    shared = regression(rows(design), y.ravel(), 1e-6 * PENALTY, np.zeros(len(PENALTY)))
    found = fit(states, width=width, ridge=(1e-6,))
    assert found.choice.per_time
    for t in range(T):
        w = regression_per_time_step(design, y, t, width, shared)
        assert np.linalg.eigvalsh(curvature(w)).min() > 0.02
        np.testing.assert_allclose(found.model.C[t, :m, :m], scale * curvature(w), atol=1e-6)
        np.testing.assert_allclose(found.model.c[t, :m], scale * w[-m - 1 : -1], atol=1e-6)
        np.testing.assert_allclose(found.model.b[t], scale * w[-1] + mean, atol=1e-6)


def test_fits_per_time_step_are_compared_at_some_steps(monkeypatch):
    """What they leave there of the shared fits' error is taken for what they leave of all of it."""
    monkeypatch.setattr(trajectories, "MOST_COMPARED", 2)
    width, states = 1.3, batch(varying, episodes=200, noise=0.3)
    y, design = standardised(states)[0], monomials(states)
    fold = np.arange(len(y)) % FOLDS
    of_all, of_some, left = 0.0, 0.0, 0.0
    for k in range(FOLDS):
        learned, judge = fold != k, fold == k
        made_of = design[learned], y[learned]
        shared = regression(*map(np.concatenate, made_of), 1e-6 * PENALTY, np.zeros(len(PENALTY)))
        wrong = np.square(design[judge] @ shared - y[judge])
        of_all, of_some = of_all + wrong.sum(), of_some + wrong[:, [0, T - 1]].sum()
        for t in (0, T - 1):
            w = regression_per_time_step(*made_of, t, width, shared)
            left += np.square(design[judge, t] @ w - y[judge, t]).sum()
    found = fit(states, width=width, ridge=(1e-6,))
    assert found.choice.per_time
    expected = 1 - of_all / np.square(y).sum() * left / of_some
    assert found.r2 == pytest.approx(expected, abs=1e-6)


def flat(z, t):
    """Eight latents, of which two cost anything."""
    return quadratic(z[:, :2], C=np.eye(2), c=np.array([2.0, -1.0]))


# Few episodes: what older ones and a ridge are for


def scored(found, truth, seed=9):
    return r2(found.model, batch(truth, seed=seed, episodes=100, size=8))


def test_a_ridge_is_chosen_where_coefficients_outnumber_what_samples_tell():
    few = batch(flat, episodes=6, size=8, noise=3.0)
    bare, chosen = (
        fit(few, features=8, per_time="never", ridge=r) for r in ((0.0,), (0.0, 0.03, 0.3))
    )
    assert chosen.choice.ridge > 0
    assert chosen.r2 > bare.r2
    assert scored(chosen, flat) > scored(bare, flat) + 0.1


def test_older_batches_support_a_fit_on_few_episodes():
    few, old = batch(flat, episodes=5, size=8, noise=1.0), batch(flat, seed=1, size=8, noise=1.0)
    alone, supported = (fit(few, features=8, older=past, per_time="never") for past in ((), (old,)))
    assert supported.choice.older == 1.0
    assert scored(supported, flat) > scored(alone, flat) + 0.02


def test_older_batches_of_another_cost_are_left_alone():
    newest, old = batch(flat, size=8), batch(lambda z, t: -z[:, 0], seed=1, size=8)
    assert fit(newest, features=8, older=(old,), per_time="never").choice.older == 0.0


def test_a_ridge_is_that_of_the_closed_form():
    ridge, states = 0.3, batch(quadratic, episodes=100)
    y, _, scale = standardised(states)
    w = regression(rows(monomials(states)), y.ravel(), ridge * PENALTY, np.zeros(len(PENALTY)))
    assert np.linalg.eigvalsh(curvature(w)).min() > 0.01
    found = fit(states, per_time="never", ridge=(ridge,)).model
    np.testing.assert_allclose(found.C[0, :m, :m], scale * curvature(w), atol=1e-8)
    np.testing.assert_allclose(found.c[0, :m], scale * w[-m - 1 : -1], atol=1e-8)
