"""Episodes that end early: control fits live steps as if the rest had never been stored."""

from functools import partial

import numpy as np
import pytest
import torch
from predicted_costs import r2

from solar_cli.control.linear_gaussian import LinearGaussianPolicy
from solar_cli.control.linearise import linearise_policy
from solar_cli.control.local_dynamics import ACTION_RIDGE, infer_dynamics
from solar_cli.control.quadratic_cost import fit_quadratic_cost
from solar_cli.control.trajectories import Trajectories, compared_steps
from solar_cli.models.basis import LatentBasis
from solar_cli.models.priors import LatentPrior
from solar_cli.settings.local import CostFit, LocalFit
from solar_cli.streams import Streams

N, T, d, a = 24, 7, 2, 1
ALL = np.full(N, T)
SOME = np.array([T, 5, 3, T, 1, 4, 2, 5] * 3)
EARLY = np.array([4, 3, 4, 2, 4, 4, 1, 4] * 3)
"""no episode lives after step 4"""


def ended(lengths, rubbish=0.0, seed=0, cost=lambda z: np.square(z).sum(axis=-1)) -> Trajectories:
    """States that actions push, in a basis of their own; what is dead is ``rubbish``."""
    rng = np.random.default_rng(seed)
    actions, z = rng.normal(size=(N, T, a)), np.empty((N, T + 1, d))
    z[:, 0] = rng.normal(size=(N, d))
    for t in range(T):
        noise = 0.05 * rng.normal(size=(N, d))
        z[:, t + 1] = z[:, t] @ [[0.9, -0.3], [0.2 + 0.05 * t, 0.8]] + actions[:, t] + noise
    means = actions + z[:, :-1] @ np.array([[0.5], [0.2]])
    costs = cost(z[:, :-1])
    live = np.arange(T) < lengths[:, None]
    for part in (actions, means, costs):
        part[~live] = rubbish
    z[np.arange(T + 1) > lengths[:, None]] = rubbish
    return Trajectories(*map(torch.as_tensor, (z, actions, means, costs, live)))


def infer(states, *older, **changes):
    """Dynamics in the basis z = latents, each time step from its own samples by default."""
    alone = {"prior_counts": (0.0,), "neighbours": (0.0,), "older_counts": (0.0,), "widths": (1.0,)}
    basis = LatentBasis(torch.eye(d).double(), torch.zeros(d).double())
    settings = LocalFit.model_validate(alone | changes)
    return infer_dynamics(states, older, LatentPrior(None, basis, d), settings, Streams(0))


def samples(states, t):
    """x (n, p) and increments (n, d) of the episodes that lived at step t."""
    live = states.live[:, t].numpy()
    z, actions = states.z.numpy()[live], states.actions.numpy()[live]
    return np.hstack([z[:, t], actions[:, t]]), z[:, t + 1] - z[:, t]


def centred(states, t):
    return [part - part.mean(axis=0) for part in samples(states, t)]


def of_increments(model):
    """Slopes and offsets of z_{t+1} - z_t."""
    F = model.F.numpy().copy()
    F[:, :, :d] -= np.eye(d)
    return F, model.f.numpy()


# Dynamics


def ridge_regression(states, weights, others=()):
    """F, f (T, ...) by loops: pooled centred sums, ridges by each step's own count."""
    every = [centred(states, t) for t in range(T)]
    x = np.concatenate([x for x, _ in every])
    ridge = np.full(d + a, 0.003)
    ridge[d:] = ACTION_RIDGE * np.sqrt(np.square(x).mean(axis=0))[d:]
    slopes, offsets = [], []
    for t in range(T):
        xx, yx = len(every[t][0]) * np.diag(ridge**2), np.zeros((d, d + a))
        for s, weight in enumerate(weights[t]):
            xx += weight * every[s][0].T @ every[s][0]
            yx += weight * every[s][1].T @ every[s][0]
        for batch, counts in others:
            x, y = centred(batch, t)
            xx, yx = xx + counts / len(x) * x.T @ x, yx + counts / len(x) * y.T @ x
        slopes.append(yx @ np.linalg.inv(xx))
        x, y = samples(states, t)
        offsets.append(y.mean(axis=0) - slopes[-1] @ x.mean(axis=0))
    return np.stack(slopes), np.stack(offsets)


def test_dynamics_are_regressions_on_the_episodes_that_live_at_each_step():
    F, f = of_increments(infer(ended(SOME, rubbish=1e3)).model)
    expected = ridge_regression(ended(SOME), np.eye(T))
    np.testing.assert_allclose(F, expected[0], rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(f, expected[1], rtol=1e-6, atol=1e-8)


def test_neighbours_and_older_batches_count_by_their_live_steps():
    newest, older = (ended(SOME, 1e3, seed) for seed in (0, 1))
    settings = {"neighbours": (0.5,), "widths": (2.0,), "older_counts": (4.0,)}
    F, f = of_increments(infer(newest, older, **settings).model)
    times = np.arange(T)
    weights = 0.5 * np.exp(-0.125 * np.square(times[:, None] - times))
    np.fill_diagonal(weights, 1.0)
    expected = ridge_regression(newest, weights, [(older, 4.0)])
    np.testing.assert_allclose(F, expected[0], rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(f, expected[1], rtol=1e-6, atol=1e-8)


def test_regression_is_least_squares_on_the_episodes_that_live_at_each_step():
    states = ended(SOME, rubbish=1e3)
    model = infer(states, method="regression").model
    F, f = of_increments(model)
    for t in range(T):
        x, y = samples(states, t)
        design = np.column_stack([x, np.ones(len(x))])
        expected = np.linalg.lstsq(design, y, rcond=None)[0].T
        np.testing.assert_allclose(F[t], expected[:, :-1], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(f[t], expected[:, -1], rtol=1e-7, atol=1e-9)
        residual = y - design @ expected.T
        Sigma = residual.T @ residual / len(x)
        np.testing.assert_allclose(model.Sigma[t], Sigma, rtol=1e-6, atol=2e-9)


@pytest.mark.parametrize("method", ["posterior", "regression", "gmm"])
def test_where_no_episode_lives_the_last_dynamics_go_on(method):
    model = infer(ended(EARLY, rubbish=1e3), method=method, neighbours=(0.5,)).model
    for part in (model.F, model.f, model.Sigma):
        assert not torch.equal(part[2], part[3])
        for t in range(4, T):
            torch.testing.assert_close(part[t], part[3], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("lengths", [SOME, EARLY])
def test_held_out_scores_are_those_of_live_steps(lengths):
    states = ended(lengths, rubbish=1e3)
    metrics = infer(states, method="regression", folds=2).metrics
    squared = total = likelihood = 0.0
    increments = np.concatenate([samples(states, t)[1] for t in range(T)])
    for fold in range(2):
        rows = np.arange(N) % 2 == fold
        learned, judge = (Trajectories(*(part[k] for part in states)) for k in (~rows, rows))
        fitted = infer(learned, method="regression", folds=2).model
        F, f = of_increments(fitted)
        for t in range(max(lengths)):
            x, y = samples(judge, t)
            residual = y - x @ F[t].T - f[t]
            Sigma = fitted.Sigma[t].numpy() * (1 + 1 / len(samples(learned, t)[0]))
            white = np.linalg.solve(np.linalg.cholesky(Sigma), residual.T)
            constant = np.linalg.slogdet(2 * np.pi * Sigma)[1]
            likelihood -= 0.5 * (np.square(white).sum() + len(x) * constant)
            squared, total = squared + np.square(residual).sum(), total + len(x)
    spread = np.square(increments - increments.mean(axis=0)).sum()
    assert metrics["one_step_r2"] == pytest.approx(1 - squared / spread)
    assert metrics["one_step_log_likelihood"] == pytest.approx(likelihood / total)


# Costs


CURVED = np.array([[2.0, 0.5], [0.5, 1.0]])


def quadratic(z):
    return 0.5 * np.einsum("...i,ij,...j->...", z, CURVED, z) + z @ [0.3, -1.0] + 4.0


@pytest.mark.parametrize("per_time", ["never", "chosen"])
def test_a_cost_is_recovered_from_live_steps(per_time):
    states = ended(SOME, rubbish=1e3, cost=quadratic)
    found = fit_quadratic_cost(states, [], 0.0, CostFit(per_time=per_time), d)
    assert found.r2 > 0.999
    assert r2(found.model, states) > 0.999
    for t in range(T):
        np.testing.assert_allclose(found.model.C[t, :d, :d], CURVED, atol=1e-3)
        np.testing.assert_allclose(found.model.b[t], 4.0, atol=1e-3)


def test_a_cost_far_from_all_live_steps_is_the_one_shared_by_all():
    """Costs that change over time, of episodes that live for three steps of a hundred."""
    rng = np.random.default_rng(0)
    z, actions = rng.normal(size=(N, 101, d)), np.zeros((N, 100, a))
    costs = np.arange(1.0, 101.0) * np.square(z[:, :-1]).sum(axis=-1)
    live = np.broadcast_to(np.arange(100) < 3, (N, 100))
    states = Trajectories(*map(torch.as_tensor, (z, actions, actions, costs, live.copy())))
    found, shared = (
        fit_quadratic_cost(states, [], 0.0, CostFit(per_time=per_time, width=0.5), d).model
        for per_time in ("chosen", "never")
    )
    for t, curvature in ((0, 2.2), (2, 5.8)):  # a neighbour weighs 0.14, and all pull
        assert float(found.C[t, 0, 0]) == pytest.approx(curvature, rel=0.2)
    for t in (10, 99):
        torch.testing.assert_close(found.C[t], shared.C[t], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("horizon", "lived"), [(100, 2), (200, 3), (50, 1)])
def test_noise_is_not_explained_by_fits_of_steps_that_nobody_lived(horizon, lived):
    rng = np.random.default_rng(0)
    z, actions = rng.normal(size=(N, horizon + 1, d)), np.zeros((N, horizon, a))
    live = np.broadcast_to(np.arange(horizon) < lived, (N, horizon)).copy()
    costs = rng.normal(size=(N, horizon))
    states = Trajectories(*map(torch.as_tensor, (z, actions, actions, costs, live)))
    assert fit_quadratic_cost(states, [], 0.0, CostFit(), d).r2 < 0.3


def test_what_is_paid_at_the_end_is_fitted_per_time_step():
    """The step that matters is among those that fits are compared at."""
    rng = np.random.default_rng(0)
    z, actions = rng.normal(size=(N, 101, d)), np.zeros((N, 100, a))
    costs = np.square(z[:, :-1]).sum(axis=-1) * (np.arange(100) == 99)
    states = Trajectories(*map(torch.as_tensor, (z, actions, actions, costs, costs > -1)))
    assert fit_quadratic_cost(states, [], 0.0, CostFit(), d).choice.per_time


# Time steps that alternatives are compared at


def test_all_steps_that_have_samples_are_compared_where_they_are_few():
    counts = torch.tensor([5.0] * 20 + [2.0] * 20 + [0.0] * 50)
    assert compared_steps(counts).tolist() == list(range(40))


@pytest.mark.parametrize("horizon", [41, 50, 100, 1000])
def test_of_many_steps_those_compared_lie_evenly_from_the_first_to_the_last(horizon):
    steps = compared_steps(torch.full((horizon,), 20.0))
    assert len(steps) == 40
    assert (int(steps[0]), int(steps[-1])) == (0, horizon - 1)
    gaps = steps.diff()
    assert int(gaps.max()) <= int(gaps.min()) + 1


def test_compared_steps_are_where_samples_are():
    """Twenty episodes live 18 steps, and two of them 1000: 360 and 1964 samples."""
    steps = compared_steps(torch.tensor([20.0] * 18 + [2.0] * 982))
    early = int((steps < 18).sum())
    assert len(steps) <= 40
    assert early == pytest.approx(40 * 360 / 2324, abs=1)
    assert int(steps[-1]) == 999


# Line 6


POLICY = LinearGaussianPolicy(
    *map(torch.as_tensor, (np.zeros((T, a, d)), np.zeros((T, a)), np.ones((T, a, a))))
)


def test_an_affine_change_is_recovered_from_live_steps():
    states, K = ended(SOME, rubbish=1e3), np.array([[0.5, 0.2]])
    means = states.z[:, :-1] @ torch.as_tensor(K.T) + 0.1
    means[~states.live] = -1e3
    A = torch.tensor([[2.0, 0.4], [-0.3, 0.7]]).double()
    fit = linearise_policy(states.z[:, :-1] @ A.T + 1.0, means, states.live, POLICY)
    torch.testing.assert_close(
        fit.policy.K, torch.as_tensor(K) @ torch.linalg.inv(A).expand(T, d, d), rtol=1e-5, atol=1e-5
    )
    torch.testing.assert_close(fit.policy.S, POLICY.S, rtol=1e-8, atol=1e-8)


def test_left_out_errors_are_of_episodes_that_live_at_each_step():
    states = ended(SOME, rubbish=1e3)
    fit = linearise_policy(states.z[:, :-1], states.action_means, states.live, POLICY)
    for t in range(T):
        live = states.live[:, t].numpy()
        z, y = states.z[live, t].numpy(), states.action_means[live, t].numpy()
        penalty = np.diag([*(len(z) * fit.ridge * z.var(axis=0)), 0.0])
        design, errors = np.column_stack([z, np.ones(len(z))]), []
        for left in range(len(z)):
            X, target = np.delete(design, left, 0), np.delete(y, left, 0)
            coefficients = np.linalg.solve(X.T @ X + penalty, X.T @ target)
            errors.append(y[left] - design[left] @ coefficients)
        expected = 1.0 + np.square(errors).mean()
        assert float(fit.policy.S[t, 0, 0]) == pytest.approx(expected, rel=1e-6)


def test_a_step_that_one_episode_lives_has_no_line_six():
    lengths = EARLY.copy()
    lengths[0] = T
    states = ended(lengths)
    with pytest.raises(ValueError, match="at least 2 episodes, got 1"):
        linearise_policy(states.z[:, :-1], states.action_means, states.live, POLICY)


# What is planned


@pytest.mark.parametrize(
    ("lengths", "planned", "reached"),
    [([7, 7, 7, 7], 7, 7), ([7, 3, 2, 2], 3, 3), ([7, 5, 3, 2, 1], 5, 3), ([4, 4], 4, 4)],
)
def test_two_episodes_are_planned_by_and_half_of_them_reach(lengths, planned, reached):
    live = np.arange(7) < np.array(lengths)[:, None]
    z, actions = np.zeros((len(lengths), 8, d)), np.zeros((len(lengths), 7, a))
    states = Trajectories(*map(torch.as_tensor, (z, actions, actions, 0.0 * live, live)))
    assert (states.planned, states.reached) == (planned, reached)


def test_the_first_steps_are_those_of_episodes_cut_short():
    states = ended(SOME)
    cut = states.until(3)
    assert torch.equal(cut.z, states.z[:, :4])
    for part, whole in zip(cut[1:], states[1:], strict=True):
        assert torch.equal(part, whole[:, :3])
    assert all(torch.equal(p, q) for p, q in zip(states.until(T), states, strict=True))


def test_the_last_gains_that_were_reached_go_on():
    policy = LinearGaussianPolicy(
        *(torch.arange(1.0, 6.0).view(5, *ones) for ones in ((1, 1), (1,), (1, 1)))
    )
    for part in policy.held(3, 7):
        assert part.flatten().tolist() == [1, 2, 3, 3, 3, 3, 3]
    for part in policy.until(2):
        assert part.flatten().tolist() == [1, 2]
    for left, right in zip(policy.held(5, 5), policy, strict=True):
        assert torch.equal(left, right)


# All of it


@pytest.mark.parametrize("lengths", [SOME, EARLY], ids=["some", "early"])
@pytest.mark.parametrize(
    "learn",
    [
        *(
            partial(infer, method=method, neighbours=(0.0, 0.5), older_counts=(0.0, 10.0))
            for method in ("posterior", "regression", "gmm")
        ),
        lambda newest, older: fit_quadratic_cost(newest, [older], 0.01, CostFit(), d),
        lambda newest, older: linearise_policy(
            newest.z[:, :3], newest.action_means[:, :3], newest.live[:, :3], POLICY.until(3)
        ),
    ],
    ids=["posterior", "regression", "gmm", "cost", "line 6"],
)
def test_what_stands_in_dead_steps_does_not_matter(learn, lengths):
    one, two = (learn(*(ended(lengths, rubbish, s) for s in (0, 1))) for rubbish in (3.0, -50.0))
    for left, right in zip(one, two, strict=True):
        if isinstance(left, tuple):
            torch.testing.assert_close(left, right, rtol=0, atol=0)
        else:
            assert left == right
