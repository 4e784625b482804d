"""Fits around the episodes against weighted regressions in NumPy, and what they are for."""

import numpy as np
import pytest
import torch

from solar_cli.control import local_cost
from solar_cli.control.convex_quadratic import Moments, least_squares
from solar_cli.control.local_cost import RIDGE, Samples, Surroundings, fitted_around
from solar_cli.control.quadratic_cost import ROUNDS, fit_quadratic_cost
from solar_cli.control.trajectories import Trajectories
from solar_cli.inference import quadratics
from solar_cli.settings.local import CostFit

N, T, m = 40, 7, 2
q = m * (m + 1) // 2 + m + 1


def arriving(seed=0, episodes=N, horizon=T):
    """(N, T, m): states that come from afar and end near zero, each episode elsewhere."""
    rng = np.random.default_rng(seed)
    way = np.linspace(3.0, 0.0, horizon)[:, None]
    return way + rng.normal(size=(episodes, horizon, m)) * (0.1 + 0.2 * way)


def distance(z):
    """App. D's kind of cost."""
    return np.abs(z).sum(axis=-1) + 0.5 * np.abs(z[..., 0])


def monomials(u):
    i, j = np.tril_indices(m)
    return np.concatenate([u[..., i] * u[..., j], u, np.ones((*u.shape[:-1], 1))], axis=-1)


def around(z, live=None):
    live = np.ones(z.shape[:2], np.bool_) if live is None else live
    return Surroundings.of(torch.as_tensor(z), torch.as_tensor(live))


def samples(z, y, fold=0):
    folds = torch.as_tensor(np.broadcast_to(fold, len(z)).copy())
    live = torch.ones(z.shape[:2], dtype=torch.bool)
    return Samples.of(torch.as_tensor(z), torch.as_tensor(y), live, folds)


def shortened(survivors, since):
    """(N, T): all episodes run until ``since``, and then only the first ``survivors``."""
    live = np.ones((N, T), np.bool_)
    live[survivors:, since:] = False
    return live


@pytest.mark.parametrize("live", [shortened(N, T), shortened(5, 4)], ids=["whole", "shortened"])
def test_surroundings_are_means_and_covariances_of_the_episodes(live):
    """Over neighbouring time steps, each about its own mean; a little is added to the variances.

    What an episode showed after it ended says nothing.
    """
    z = arriving()
    found = around(np.where(live[..., None], z, np.nan), live)
    each = [z[live[:, t], t] for t in range(T)]
    for t in range(T):
        np.testing.assert_allclose(found.centre[t], each[t].mean(axis=0), atol=1e-12)
        weight = np.exp(-0.5 * np.square((np.arange(T) - t) / local_cost.SMOOTHING))
        sums = sum(w * len(s) * np.cov(s.T, bias=True) for w, s in zip(weight, each, strict=True))
        expected = sums / (weight @ np.array([len(s) for s in each]))
        variances = local_cost.SHRINKAGE * np.diag(expected) + local_cost.LEAST_VARIANCE
        expected = expected + np.diag(variances)
        np.testing.assert_allclose(found.L[t] @ found.L[t].mT, expected, atol=1e-12)


def test_samples_are_of_steps_at_which_an_episode_ran():
    z, live = arriving(), shortened(5, 4)
    fold = torch.arange(N) % 4
    costs = np.where(live, distance(z), 1e6)
    some = Samples.of(torch.as_tensor(z), torch.as_tensor(costs), torch.as_tensor(live), fold)
    assert len(some.y) == live.sum()
    np.testing.assert_array_equal(some.y, distance(some.z.numpy()))
    assert np.bincount(some.fold).tolist() == [live[k::4].sum() for k in range(4)]


@pytest.mark.parametrize("reach", [0.8, 3.0])
def test_a_fit_is_a_weighted_regression_in_white_coordinates(monkeypatch, reach):
    """Pulled towards the shared quadratic. Where it is convex, it is what is found."""
    monkeypatch.setattr(local_cost, "REACH", reach)
    z, rng = arriving(), np.random.default_rng(1)
    where = around(z)
    bowl = 0.5 * np.square(z).sum(axis=-1) + z[..., 0] * z[..., 1] / 3
    y = bowl + 0.2 * np.abs(z[..., 1]) + 0.05 * rng.normal(size=z.shape[:2])
    shared = torch.as_tensor(np.array([0.6, 0.1, 0.4, 0.2, -0.3, 1.0]))
    found = fitted_around(where, samples(z, y), [shared], [None])[0]
    flat, costs = z.reshape(-1, m), y.ravel()
    for t in range(T):
        L, centre = where.L[t].numpy(), where.centre[t].numpy()
        x = monomials(np.linalg.solve(L, (flat - centre).T).T)
        weight = np.exp(-0.5 * np.square(x[:, -m - 1 : -1]).sum(axis=-1) / reach**2)
        weight /= weight.sum()
        grid = rng.normal(size=(30, m))
        towards = np.linalg.lstsq(
            monomials(grid), monomials(grid @ L.T + centre) @ shared.numpy(), rcond=None
        )[0]
        penalty = RIDGE * (weight @ np.square(x)) + local_cost.LEAST_PENALTY
        left = (x * weight[:, None]).T @ x + np.diag(penalty)
        w = np.linalg.solve(left, (x * weight[:, None]).T @ costs + penalty * towards)
        C = quadratics.curvature(torch.as_tensor(w))
        assert float(torch.linalg.eigvalsh(C).min()) > 0
        np.testing.assert_allclose(monomials(flat) @ found[t].numpy(), x @ w, atol=1e-8)


def test_samples_of_a_fold_that_is_held_out_count_for_nothing():
    z, fold = arriving(), np.arange(N) % 4
    y = distance(z)
    changed = np.where((fold == 2)[:, None], 1e3, y)
    shared = [torch.zeros(q).double()] * 2
    fits = [fitted_around(around(z), samples(z, one, fold), shared, [2, 3]) for one in (y, changed)]
    torch.testing.assert_close(fits[0][0], fits[1][0], rtol=0, atol=1e-8)
    assert float((fits[0][1] - fits[1][1]).abs().max()) > 1


def test_of_many_samples_some_are_drawn(monkeypatch):
    """The same ones every time, and each with what belongs to it."""
    monkeypatch.setattr(local_cost, "MOST_SAMPLES", 50)
    z, fold = arriving(), np.arange(N) % 4
    some = samples(z, distance(z), fold)
    assert len(some.y) == len(some.z) == len(some.fold) == 50
    assert len(torch.unique(some.z, dim=0)) == 50
    assert set(some.fold.tolist()) == {0, 1, 2, 3}
    np.testing.assert_array_equal(some.y, distance(some.z.numpy()))
    torch.testing.assert_close(some, samples(z, distance(z), fold), rtol=0, atol=0)


@pytest.mark.parametrize("survivors", [0, local_cost.LEAST_EPISODES - 1])
def test_where_few_survive_the_shared_fit_goes_on(survivors):
    z, live = arriving(), shortened(survivors, 5)
    shared = torch.as_tensor(np.array([0.6, 0.1, 0.4, 0.2, -0.3, 1.0]))
    found = fitted_around(around(z, live), samples(z, distance(z)), [shared], [None])[0]
    torch.testing.assert_close(found[5:], shared.expand(2, -1))
    assert float((found[:5] - shared).abs().max()) > 0.01


# In the cost fit


def batch(cost, seed=0, episodes=15, horizon=30, noise=0.0):
    """States in four dimensions that come from afar, and then stay around zero for long."""
    rng, features = np.random.default_rng(seed), 4
    way = np.maximum(10.0 - np.arange(horizon + 1), 0.0)[:, None]
    z = way + 0.4 * rng.normal(size=(episodes, horizon + 1, features))
    costs = cost(z[:, :-1]) + noise * rng.normal(size=(episodes, horizon))
    nothing = np.zeros((episodes, horizon, 1))
    return Trajectories(*map(torch.as_tensor, (z, nothing, nothing, costs, costs > -np.inf)))


def fit(states, **settings):
    return fit_quadratic_cost(states, [], 0.0, CostFit.model_validate(settings), 4)


def within(found, judge):
    """Share of what costs of other episodes differ by at a time step."""
    z, costs = judge.z[:, :-1].numpy(), judge.costs.numpy()
    C, c = found.model.C[:-1, :4, :4].numpy(), found.model.c[:-1, :4].numpy()
    wrong = costs - 0.5 * np.einsum("nti,tij,ntj->nt", z, C, z) - np.einsum("nti,ti->nt", z, c)
    left, total = (np.square(part - part.mean(axis=0)).sum() for part in (wrong, costs))
    return 1 - left / total


def test_a_sum_of_distances_is_fitted_around_the_episodes():
    """R2 of all costs is near 1 either way; what episodes differ by tells them apart."""
    states, judge = batch(distance, episodes=40), batch(distance, seed=1, episodes=200)
    around, together = fit(states), fit(states, per_time="never")
    assert around.choice.around
    assert not together.choice.around
    assert together.r2 > 0.98
    assert around.within > together.within + 0.1
    assert within(around, judge) > within(together, judge) + 0.1
    assert within(around, judge) == pytest.approx(around.within, abs=0.1)


def test_a_quadratic_cost_needs_no_fit_around_the_episodes():
    found = fit(batch(lambda z: np.square(z).sum(axis=-1)))
    assert not found.choice.around
    assert found.within > 0.999


@pytest.mark.parametrize("step", [4, 8])
def test_a_few_survivors_of_one_fold_that_drift_away_harm_nothing(step):
    """Without that fold there are no samples where they are, and no rounding is left of them."""
    states = batch(distance, episodes=20, horizon=40)
    live = torch.ones(states.live.shape, dtype=torch.bool)
    live[torch.arange(20) % step != 0, 20:] = False
    z = states.z.clone()
    z[:, 21:] += torch.linspace(0, 50, 20).double()[None, :, None]
    drifting = states._replace(z=z, live=live)
    found = fit(drifting)
    assert np.isfinite(found.within)
    assert bool(torch.isfinite(found.model.C).all())
    together = fit(drifting, per_time="never")
    assert float(found.model.C[21:].abs().max()) < 3 * float(together.model.C.abs().max())


@pytest.mark.parametrize("episodes", [1, 2, 5, local_cost.LEAST_EPISODES - 1])
def test_few_episodes_tell_no_surroundings(episodes):
    found = fit(batch(distance, episodes=episodes))
    assert not found.choice.around
    assert np.isfinite(found.within)


def test_costs_that_only_time_tells_leave_nothing_to_explain():
    found = fit(batch(lambda z: np.broadcast_to(np.arange(30.0), z.shape[:2]), episodes=20))
    assert found.within == 1.0


def test_of_fits_around_the_episodes_each_is_judged_by_what_it_was_not_given():
    """The share is that of the same fits, made here, on the folds that they were made without."""
    states = batch(distance, episodes=20, horizon=12)
    found = fit(states, ridge=(1e-4,))
    assert found.choice.around
    z, folds = states.z[:, :-1].numpy(), np.arange(20) % 4
    costs = states.costs.numpy()
    y = (costs - costs.mean()) / costs.std(ddof=1)
    wrong, where = np.zeros_like(y), around(z)
    for k in range(4):
        kept, judge = folds != k, folds == k
        live = torch.ones(y[kept].shape, dtype=torch.bool)
        own = Moments.of(torch.as_tensor(z[kept]), torch.as_tensor(y[kept]), live)
        mean = own.together().mean()
        penalty = 1e-4 * quadratics.squares(mean.xy.shape[-1]).to(mean.xy)
        shared = least_squares(mean, penalty, torch.zeros_like(mean.xy), ROUNDS)
        near = fitted_around(where, samples(z[kept], y[kept]), [shared], [None])[0]
        x = quadratics.monomials(torch.as_tensor(z[judge]))
        wrong[judge] = y[judge] - (x * near).sum(dim=-1).numpy()
    left, total = (np.square(part - part.mean(axis=0)).sum() for part in (wrong, y))
    assert found.within == pytest.approx(1 - left / total, abs=1e-6)


def test_curvature_is_never_negative():
    found = fit(batch(lambda z: -distance(z), episodes=40))
    assert found.choice.around
    assert float(torch.linalg.eigvalsh(found.model.C[:-1, :4, :4]).min()) > -1e-9
