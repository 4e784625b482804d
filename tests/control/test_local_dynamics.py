"""INFERDYNAMICS against the systems that made the data, and against regressions in NumPy.

Two systems: one whose latents say all (W = 1), and one whose velocity is hidden and lives in the
differences of a window of four latents.
"""

import math
from functools import cache, partial

import numpy as np
import pytest
import torch
from scipy import stats

from solar_cli.control import trajectories
from solar_cli.control.local_dynamics import ACTION_RIDGE, infer_dynamics
from solar_cli.control.trajectories import Trajectories
from solar_cli.inference import gmm, mniw
from solar_cli.models.basis import LatentBasis
from solar_cli.models.priors import LatentPrior
from solar_cli.models.transition import TransitionNetwork
from solar_cli.settings.local import LocalFit, NetworkFit, Transition
from solar_cli.streams import Streams

d, a, T = 2, 2, 8
NOISE = 0.05


def only_data(**changes) -> LocalFit:
    """A fit that each time step makes from its own episodes."""
    none = {"prior_counts": (0.0,), "neighbours": (0.0,), "older_counts": (0.0,)}
    return LocalFit.model_validate(none | {"widths": (1.0,), **changes})


FIRST_ORDER = np.array([[0.9, 0.2], [-0.3, 0.8]])


def first_order(episodes, seed=0, horizon=T, varying=0.0, M=FIRST_ORDER):
    """y' = M_t y + B a + c + noise: latents (N, T+1, d), actions, and M, B, c."""
    rng, fixed = np.random.default_rng(seed), np.random.default_rng(100)
    M = M + varying * fixed.normal(size=(horizon, d, d))
    B, c = np.array([[0.5, 0.1], [0.0, 0.4]]), np.array([0.3, -0.1])
    actions = rng.normal(0, 0.4, (episodes, horizon, a))
    y = np.empty((episodes, horizon + 1, d))
    y[:, 0] = rng.normal(size=(episodes, d)) + 1.0
    for t in range(horizon):
        noise = NOISE * rng.normal(size=(episodes, d))
        y[:, t + 1] = y[:, t] @ M[t].T + actions[:, t] @ B.T + c + noise
    return y, actions, M, B, c


def second_order(episodes, seed=0, horizon=T):
    """p' = p + v', v' = 0.8 v + B a + noise, of which only p is seen; it starts at rest."""
    rng = np.random.default_rng(seed)
    B = np.array([[0.5, 0.1], [0.0, 0.4]])
    actions = rng.normal(0, 0.4, (episodes, horizon, a))
    p = np.empty((episodes, horizon + 1, d))
    p[:, 0], v = rng.normal(size=(episodes, d)), np.zeros((episodes, d))
    for t in range(horizon):
        v = 0.8 * v + actions[:, t] @ B.T + NOISE * rng.normal(size=(episodes, d))
        p[:, t + 1] = p[:, t] + v
    return p, actions, B


def windows(y, window) -> torch.Tensor:
    """(N, T+1, W, d), newest first; the first frame repeats before the start."""
    times = np.maximum(np.arange(y.shape[1])[:, None] - np.arange(window), 0)
    return torch.as_tensor(y[:, times])


def states(y, actions, window=1, basis=None) -> tuple[Trajectories, LatentBasis]:
    w = windows(y, window)
    basis = LatentBasis.whitening(w.flatten(0, 1)) if basis is None else basis
    executed = torch.as_tensor(actions)
    costs = torch.zeros(executed.shape[:2]).double()
    return Trajectories(basis.state(w), executed, executed, costs, costs == 0), basis


def infer(newest, basis, settings, older=(), factor=None, seed=0):
    prior = LatentPrior(factor, basis, d)
    return infer_dynamics(newest, older, prior, settings, Streams(seed))


@cache
def true_basis(window) -> LatentBasis:
    """One basis for batches of every size, so that their fits can be compared."""
    y = first_order(2000, seed=50)[0] if window == 1 else second_order(2000, seed=50)[0]
    return LatentBasis.whitening(windows(y, window).flatten(0, 1))


def truth(window, M=FIRST_ORDER):
    """F, f, Sigma (T, ...) in the states of `true_basis`, by algebra on windows."""
    A, b = (part.numpy() for part in true_basis(window))
    size = window * d
    shift, enter = np.eye(size, k=-d), np.eye(size, d)
    if window == 1:
        _, _, M, B, c = first_order(1, M=M)
    else:
        _, _, B = second_order(1)
        M = np.tile(
            np.hstack([1.8 * np.eye(d), -0.8 * np.eye(d), np.zeros((d, size - 2 * d))]), (T, 1, 1)
        )
        c = np.zeros(d)
    F_z = A @ (shift + enter @ M) @ np.linalg.inv(A)
    F_a = np.tile(A @ enter @ B, (T, 1, 1))
    f = A @ enter @ c + b - F_z @ b
    Sigma = np.tile(NOISE**2 * A @ enter @ enter.T @ A.T, (T, 1, 1))
    return np.concatenate([F_z, F_a], axis=-1), f, Sigma


def errors(window, episodes, settings, seed=1):
    """Largest errors of F, f and Sigma (relative to its size) where the window has filled."""
    y, actions = (first_order if window == 1 else second_order)(episodes, seed)[:2]
    newest, basis = states(y, actions, window, true_basis(window))
    model = infer(newest, basis, settings).model
    filled = slice(window - 1, None)
    F, f, Sigma = (part[filled] for part in truth(window))
    return (
        np.abs(model.F[filled].numpy() - F).max(),
        np.abs(model.f[filled].numpy() - f).max(),
        np.abs(model.Sigma[filled].numpy() - Sigma).max() / np.abs(Sigma).max(),
    )


# The truth


SHEAR = np.array([[0.9, 0.2], [0.1, 0.8]])
"""I + v r^T, as RCE's network has it."""


def exact_network(window) -> TransitionNetwork:
    """A network that gives the system's transitions at every place, in units of its own."""
    network = TransitionNetwork(Transition(hidden=(3,)), d, window, a, action_std=0.4)
    torch.manual_seed(0)
    network.mean.normal_(), network.std.uniform_(0.5, 2.0), network.difference_std.uniform_(0.2, 1)
    if window == 1:
        _, _, _, B, c = first_order(1, M=SHEAR)
        M, c = torch.as_tensor(SHEAR), torch.as_tensor(c)
    else:
        M, B, c = torch.eye(d).double(), second_order(1)[2], torch.zeros(d).double()
    std, eye, last = network.std, torch.eye(d), network.layers[-1]
    U, s, Vh = torch.linalg.svd((M - eye) * std / std[:, None])
    assert s[1] < 1e-9
    C = 0.8 * torch.eye(d, (window - 1) * d) * network.difference_std / std[:, None]
    o = ((M - eye) @ network.mean + c) / std
    parts = (
        U[:, 0] * s[0],
        Vh[0],
        C.flatten(),
        (torch.as_tensor(B) * 0.4 / std[:, None]).flatten(),
    )
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(torch.cat([*parts, o]))
    return network


@pytest.mark.parametrize("window", [1, 4])
def test_a_network_that_is_right_gives_the_true_slopes_at_once(window):
    """And their offset and noise as the samples of a time step show them."""
    basis, episodes = true_basis(window), 400
    system = partial(first_order, M=SHEAR) if window == 1 else second_order
    y, actions = system(episodes, seed=1)[:2]
    newest, _ = states(y, actions, window, basis)
    prior = LatentPrior(None, basis, d, exact_network(window))
    found = infer_dynamics(newest, [], prior, NetworkFit(), Streams(0))
    filled = slice(window - 1, None)
    F, f, Sigma = (part[filled] for part in truth(window, SHEAR))
    np.testing.assert_allclose(found.model.F[filled], F, atol=1e-9)
    error = NOISE * np.abs(basis.A.numpy()).max() / math.sqrt(episodes)
    assert np.abs(found.model.f[filled].numpy() - f).max() < 5 * error
    assert np.abs(found.model.Sigma[filled].numpy() - Sigma).max() < 0.25 * np.abs(Sigma).max()
    assert found.metrics["one_step_r2"] > 0.9


@pytest.mark.parametrize("window", [1, 4])
@pytest.mark.parametrize("method", ["posterior", "regression"])
def test_dynamics_approach_the_truth_as_episodes_are_added(window, method):
    settings = only_data(method=method, folds=2)
    few, many = (errors(window, episodes, settings) for episodes in (40, 4000))
    # A hundred times the episodes: a tenth of the error, but for chance and for a fixed ridge.
    for name, before, now in zip(("F", "f", "Sigma"), few, many, strict=True):
        assert now < 0.35 * before, (name, before, now)
    # The least certain direction of four latents is the oldest difference, which is nearly
    # collinear with the others: its std is about the noise, so slopes err by 1 / sqrt(N).
    assert many[0] < 0.1
    assert many[1] < 0.1
    assert many[2] < 0.15


def test_a_mixture_prior_gives_way_to_the_episodes():
    settings = only_data(method="gmm")
    few, many = (errors(1, episodes, settings) for episodes in (10, 250))
    # Twenty-five times the episodes: a fifth of the error, but for chance.
    for name, before, now in zip(("F", "f", "Sigma"), few, many, strict=True):
        assert now < 0.5 * before, (name, before, now)
    assert max(many[:2]) < 0.1


@pytest.mark.parametrize("window", [1, 4])
@pytest.mark.parametrize("method", ["posterior", "regression", "gmm"])
def test_shifting_is_exact_whatever_is_inferred(window, method):
    """The model's next state is that of a window that was shifted: exactly, on any state."""
    y, actions = (first_order if window == 1 else second_order)(12, seed=3)[:2]
    newest, basis = states(y, actions, window)
    model = infer(newest, basis, LocalFit(method=method)).model
    rng = np.random.default_rng(4)
    w = torch.as_tensor(rng.normal(size=(window, d)))
    action = torch.as_tensor(rng.normal(size=a))
    A, b = basis
    _, G, _ = basis.successor(d)
    for t in range(T):
        z = basis.state(w)
        after = model.F[t] @ torch.cat([z, action]) + model.f[t]
        newest_latent = torch.linalg.solve(A[:d, :d], after[:d] - b[:d])
        shifted = torch.cat([newest_latent[None], w[:-1]])
        torch.testing.assert_close(after, basis.state(shifted), rtol=1e-8, atol=1e-8)
        inner = model.Sigma[t, :d, :d]
        torch.testing.assert_close(model.Sigma[t], G @ inner @ G.T, rtol=1e-8, atol=1e-12)
        assert float(torch.linalg.eigvalsh(inner).min()) > 0


def test_the_initial_state_is_that_of_the_episodes():
    y, actions = first_order(30)[:2]
    newest, basis = states(y, actions)
    model = infer(newest, basis, only_data()).model
    start = newest.z[:, 0].numpy()
    np.testing.assert_allclose(model.mu0, start.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(model.Sigma0, np.cov(start.T, bias=True), atol=1e-8)
    assert float(torch.linalg.eigvalsh(model.Sigma0).min()) > 0


# Appendix B in NumPy


def regression_inputs(trajectories):
    """x (T, N, p) and increments of the newest block (T, N, d)."""
    z, actions = trajectories.z.numpy(), trajectories.actions.numpy()
    x = np.concatenate([z[:, :-1], actions], axis=-1)
    y = z[:, 1:, :d] - z[:, :-1, :d]
    return x.swapaxes(0, 1), y.swapaxes(0, 1)


def centred(values):
    return values - values.mean(axis=1, keepdims=True)


def sums(x, y):
    """Centred sums of every time step."""
    x, y = centred(x), centred(y)
    xx, yx = np.einsum("tni,tnj->tij", x, x), np.einsum("tni,tnj->tij", y, x)
    return np.einsum("tni,tnj->tij", y, y), yx, xx, np.full(len(x), float(x.shape[1]))


def ridge_regression(x, y, whole_x, settings, weights, others=()):
    """Increment slopes and covariance of every time step, from sums of weighted evidence.

    ``weights`` (T, T) are of the other steps' sums; ``others`` are (counts, sums of one count).
    """
    yy, yx, xx, n = sums(x, y)
    spread = np.sqrt(np.square(centred(whole_x)).mean(axis=(0, 1)))
    penalty = np.full(x.shape[-1], settings.ridge)
    penalty[-a:] = ACTION_RIDGE * spread[-a:]
    F, f, Sigma = [], [], []
    for t in range(len(x)):
        A = sum(weights[t, s] * yy[s] for s in range(len(x)))
        B = sum(weights[t, s] * yx[s] for s in range(len(x)))
        C = sum(weights[t, s] * xx[s] for s in range(len(x)))
        count = sum(weights[t, s] * n[s] for s in range(len(x)))
        for counts, part in others:
            A, B, C = A + counts * part[0], B + counts * part[1], C + counts * part[2]
            count += counts * part[3]
        A = A + (d + 2) * settings.ridge**2 * np.eye(d)
        C = C + whole_x.shape[1] * np.diag(penalty**2)
        slopes = np.linalg.solve(C, B.T).T
        F.append(slopes)
        f.append(y[t].mean(axis=0) - slopes @ x[t].mean(axis=0))
        Sigma.append((A - slopes @ B.T) / (count + d + 2) + 1e-9 * np.eye(d))
    return np.array(F), np.array(f), np.array(Sigma)


def assert_increments(model, basis, expected, window=1):
    """Compare the newest block's rows with the increments that NumPy finds."""
    F, f, Sigma = expected
    whole = F.copy()
    whole[..., :d] += np.eye(d)  # u' = u + increment
    np.testing.assert_allclose(model.F[:, :d], whole, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(model.f[:, :d], f, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(model.Sigma[:, :d, :d], Sigma, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("window", [1, 4])
def test_without_pseudo_counts_the_posterior_is_ridge_regression(window):
    y, actions = (first_order if window == 1 else second_order)(20, seed=5)[:2]
    newest, basis = states(y, actions, window)
    settings = only_data(ridge=0.02)
    x, increments = regression_inputs(newest)
    expected = ridge_regression(x, increments, x, settings, np.eye(T))
    assert_increments(infer(newest, basis, settings).model, basis, expected)


def test_neighbours_count_by_their_distance():
    y, actions = first_order(20, seed=5)[:2]
    newest, basis = states(y, actions)
    settings = only_data(neighbours=(0.5,), widths=(2.0,))
    x, increments = regression_inputs(newest)
    distance = np.subtract.outer(np.arange(T), np.arange(T))
    weights = np.where(distance == 0, 1.0, 0.5 * np.exp(-(distance**2) / 8))
    expected = ridge_regression(x, increments, x, settings, weights)
    assert_increments(infer(newest, basis, settings).model, basis, expected)


@pytest.mark.parametrize("window", [1, 4])
def test_pseudo_counts_are_of_the_factor_and_of_older_batches(window):
    make = first_order if window == 1 else second_order
    newest, basis = states(*make(20, seed=5)[:2], window)
    past = [states(*make(n, seed=n)[:2], window, basis)[0] for n in (7, 11)]
    settings = only_data(prior_counts=(9.0,), older_counts=(4.0,))
    # The factor is over [newest latent | window; a; 1] of yet other episodes.
    y, actions = make(30, seed=6)[:2]
    w = windows(y, window)[:, :-1].flatten(2)
    one = torch.ones(*w.shape[:2], 1).double()
    regressors = torch.cat([w, torch.as_tensor(actions), one], dim=-1).flatten(0, 1)
    factor = mniw.regression_statistics(regressors, torch.as_tensor(y[:, 1:]).flatten(0, 1))
    of_factor, _ = states(y, actions, window, basis)
    x, increments = (part.reshape(1, 30 * T, -1) for part in regression_inputs(of_factor))
    model_sums = [part[0] / (30 * T - 1) for part in sums(x, increments)]
    model_sums[3] = 1.0  # an intercept takes one of the counts, the rest are scaled to one
    older = [sums(*regression_inputs(batch)) for batch in past]
    older_sums = [(first + second) / 18 for first, second in zip(*older, strict=True)]
    x, increments = regression_inputs(newest)
    fit = infer(newest, basis, settings, past, factor)
    for t in range(T):
        others = [(9.0, model_sums), (4.0, [part[t] for part in older_sums])]
        expected = ridge_regression(x, increments, x, settings, np.eye(T), others)
        now = [part[t : t + 1] for part in expected]
        part = fit.model._replace(
            F=fit.model.F[t : t + 1], f=fit.model.f[t : t + 1], Sigma=fit.model.Sigma[t : t + 1]
        )
        assert_increments(part, basis, now)
    assert (fit.metrics["prior_model"], fit.metrics["prior_older"]) == (9.0, 4.0)


@pytest.mark.parametrize("factors", ["shared", "varying"])
def test_the_models_own_factor_is_the_prior_as_it_stands(factors):
    """Section 4.1 as printed: the prior of a time step is q(F, Sigma), with all its counts."""
    newest, basis = states(*first_order(20, seed=5)[:2])
    y, actions = first_order(30, seed=6)[:2]
    one = np.ones((30, T, 1))
    regressors = torch.as_tensor(np.concatenate([y[:, :-1], actions, one], axis=-1))
    targets = torch.as_tensor(y[:, 1:])
    if factors == "shared":
        factor = mniw.regression_statistics(regressors.flatten(0, 1), targets.flatten(0, 1))
    else:
        factor = mniw.regression_statistics(regressors.transpose(0, 1), targets.transpose(0, 1))
    x, increments = regression_inputs(states(y, actions, basis=basis)[0])
    settings = only_data(prior_counts="own")
    fit = infer(newest, basis, settings, factor=factor)
    own_x, own_y = regression_inputs(newest)
    for t in range(T):
        if factors == "shared":
            part = [p[0] for p in sums(x.reshape(1, 30 * T, -1), increments.reshape(1, 30 * T, -1))]
        else:
            part = [p[t] for p in sums(x, increments)]
        part[3] -= 1.0  # the intercept's
        expected = ridge_regression(own_x, own_y, own_x, settings, np.eye(T), [(1.0, part)])
        found = fit.model._replace(
            F=fit.model.F[t : t + 1], f=fit.model.f[t : t + 1], Sigma=fit.model.Sigma[t : t + 1]
        )
        assert_increments(found, basis, [p[t : t + 1] for p in expected])
    assert fit.metrics["prior_model"] == 1.0


@pytest.mark.parametrize(("at_most", "times"), [(T, range(T)), (3, [0, 4, 7])])
def test_held_out_likelihood_is_that_of_refitting_without_the_fold(monkeypatch, at_most, times):
    monkeypatch.setattr(trajectories, "MOST_COMPARED", at_most)
    y, actions = first_order(7, seed=5)[:2]
    newest, basis = states(y, actions)
    settings = only_data(folds=3)
    x, increments = regression_inputs(newest)
    likelihood = squared = 0.0
    for fold in range(3):
        judge = np.arange(7) % 3 == fold
        F, f, Sigma = ridge_regression(x[:, ~judge], increments[:, ~judge], x, settings, np.eye(T))
        for t in times:
            predicted = x[t, judge] @ F[t].T + f[t]
            # The means of n episodes are uncertain by Sigma / n.
            spread = Sigma[t] * (1 + 1 / (~judge).sum())
            residual = increments[t, judge] - predicted
            likelihood += stats.multivariate_normal(np.zeros(d), spread).logpdf(residual).sum()
            squared += np.square(residual).sum()
    metrics = infer(newest, basis, settings).metrics
    assert metrics["one_step_log_likelihood"] == pytest.approx(
        likelihood / (7 * len(times)), rel=1e-6
    )
    judged = increments[list(times)]
    total = np.square(judged - judged.mean(axis=(0, 1))).sum()
    assert metrics["one_step_r2"] == pytest.approx(1 - squared / total, rel=1e-6)


@pytest.mark.parametrize("window", [1, 4])
def test_regression_is_least_squares_at_every_time_step(window):
    make = first_order if window == 1 else second_order
    newest, basis = states(*make(40, seed=5)[:2], window)
    model = infer(newest, basis, only_data(method="regression")).model
    x, increments = regression_inputs(newest)
    for t in range(window - 1, T):
        design = np.column_stack([x[t], np.ones(40)])
        solution = np.linalg.lstsq(design, increments[t], rcond=None)[0]
        F = solution[:-1].T.copy()
        F[:, :d] += np.eye(d)
        np.testing.assert_allclose(model.F[t, :d], F, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(model.f[t, :d], solution[-1], rtol=1e-6, atol=1e-6)
        Sigma = np.cov((increments[t] - design @ solution).T, bias=True)
        np.testing.assert_allclose(model.Sigma[t, :d, :d], Sigma, rtol=1e-5, atol=2e-9)


# What the likelihood chooses


GRID = {"prior_counts": (0.0, 100.0), "neighbours": (0.0, 0.5), "widths": (2.0, 5.0)}


def global_factor(varying):
    """What a model learned of many episodes, all time steps in one."""
    y, actions = first_order(200, seed=9, varying=varying)[:2]
    w = torch.as_tensor(y[:, :-1])
    one = torch.ones(*w.shape[:2], 1).double()
    x = torch.cat([w, torch.as_tensor(actions), one], dim=-1).flatten(0, 1)
    return mniw.regression_statistics(x, torch.as_tensor(y[:, 1:]).flatten(0, 1))


def chosen(episodes, varying):
    newest, basis = states(*first_order(episodes, seed=8, varying=varying)[:2])
    settings = LocalFit.model_validate(GRID)
    return infer(newest, basis, settings, factor=global_factor(varying)).metrics


def test_few_episodes_of_a_time_invariant_system_are_pooled():
    metrics = chosen(episodes=6, varying=0.0)
    assert metrics["prior_model"] == 100.0
    assert metrics["one_step_r2"] > 0.9


def test_many_episodes_of_a_time_varying_system_stand_for_themselves():
    metrics = chosen(episodes=150, varying=0.5)
    assert (metrics["prior_model"], metrics["prior_neighbours"]) == (0.0, 0.0)
    assert metrics["one_step_r2"] > 0.9


def test_without_a_factor_neighbours_are_what_is_pooled():
    newest, basis = states(*first_order(6, seed=8)[:2])
    metrics = infer(newest, basis, LocalFit.model_validate(GRID)).metrics
    assert metrics["prior_model"] == 0.0
    assert (metrics["prior_neighbours"], metrics["prior_width"]) == (0.5, 5.0)


def test_older_batches_are_used_when_they_are_of_the_same_system():
    settings = only_data(older_counts=(0.0, 20.0))
    newest, basis = states(*first_order(5, seed=8)[:2])
    same, _ = states(*first_order(60, seed=10)[:2], basis=basis)
    assert infer(newest, basis, settings, [same]).metrics["prior_older"] == 20.0
    newest, basis = states(*first_order(30, seed=8)[:2])
    y, actions = first_order(60, seed=11)[:2]
    other, _ = states(y, -actions, basis=basis)  # a system that does the opposite
    assert infer(newest, basis, settings, [other]).metrics["prior_older"] == 0.0


def test_the_choice_is_the_best_of_the_grid():
    newest, basis = states(*first_order(9, seed=8, varying=0.1)[:2])
    factor = global_factor(0.1)
    best = infer(newest, basis, LocalFit.model_validate(GRID), factor=factor).metrics
    alone = []
    for counts in GRID["prior_counts"]:
        for share in GRID["neighbours"]:
            for width in GRID["widths"]:
                one = only_data(prior_counts=(counts,), neighbours=(share,), widths=(width,))
                alone.append(infer(newest, basis, one, factor=factor).metrics)
    top = max(alone, key=lambda metrics: metrics["one_step_log_likelihood"])
    assert best["one_step_log_likelihood"] == top["one_step_log_likelihood"]
    assert best["prior_model"] == top["prior_model"]


# What must not break it


@pytest.mark.parametrize("method", ["posterior", "regression", "gmm"])
@pytest.mark.parametrize("window", [1, 4])
def test_constant_dimensions_break_nothing(method, window):
    """A latent that never moves, an action entry that is never used, an offset far from zero."""
    y, actions = (first_order if window == 1 else second_order)(30, seed=5)[:2]
    y[..., 1] = 3.0
    actions[..., 1] = 0.0
    newest, basis = states(y, actions, window)
    model = infer(newest, basis, LocalFit(method=method)).model
    assert all(bool(torch.isfinite(part).all()) for part in model)
    assert float(torch.linalg.eigvalsh(model.Sigma).min()) > -1e-9
    x, increments = regression_inputs(newest)
    predicted = np.einsum("tij,tnj->tni", model.F[:, :d].numpy(), x) + model.f[:, None, :d].numpy()
    residual = predicted - x[..., :d] - increments
    # The latent that moves is predicted but for what is hidden now, the one that does not stays.
    assert np.square(residual[..., 1]).mean() < 0.3 * increments[..., 1].var()
    assert np.abs(residual[..., 0]).max() < 1e-3


def test_two_episodes_are_enough_to_infer_something():
    newest, basis = states(*second_order(2, seed=5)[:2], 4)
    for method in ("posterior", "regression"):
        model = infer(newest, basis, LocalFit(method=method)).model
        assert all(bool(torch.isfinite(part).all()) for part in model)


def test_a_mixture_prior_sees_older_batches():
    newest, basis = states(*first_order(6, seed=5)[:2])
    past = [states(*first_order(60, seed=n)[:2], basis=basis)[0] for n in (7, 11)]
    alone, informed = (
        infer(newest, basis, only_data(method="gmm"), older).metrics for older in ([], past)
    )
    assert informed["one_step_log_likelihood"] > alone["one_step_log_likelihood"] + 0.5
    assert informed["one_step_r2"] > alone["one_step_r2"]


def test_a_mixture_prior_is_drawn_from_its_streams():
    newest, basis = states(*first_order(20, seed=5, varying=0.3)[:2])
    first, again, other = (
        infer(newest, basis, only_data(method="gmm"), seed=seed).model for seed in (0, 0, 1)
    )
    assert torch.equal(first.F, again.F)
    assert not torch.equal(first.F, other.F)


def test_a_mixture_prior_gives_the_fit_of_guided_policy_search():
    """Levine and Abbeel's normal-inverse-Wishart fit of [x; u; x'], time step by time step.

    Here it is increments that are fitted: a linear change of the point, which changes no Gaussian.
    """
    newest, basis = states(*first_order(12, seed=5, varying=0.3)[:2])
    past = states(*first_order(30, seed=6, varying=0.3)[:2], basis=basis)[0]
    found = infer(newest, basis, only_data(method="gmm"), [past]).model
    batches = [np.concatenate(regression_inputs(one), axis=-1) for one in (newest, past)]
    flat = torch.as_tensor(np.concatenate([one.reshape(-1, 2 * d + a) for one in batches]))
    clusters = gmm.cluster_count(len(flat))
    mixture = gmm.fit_mixture(flat, clusters, Streams(0).generator("mixture")).mixture
    change = np.eye(2 * d + a)
    change[d + a :, :d] = np.eye(d)  # x' = x + increment
    means = mixture.means.numpy() @ change.T
    covariances = change @ mixture.covariances.numpy() @ change.T
    D, P, p = 2 * d + a, len(flat), d + a
    for t, own in enumerate(batches[0] @ change.T):
        N = len(own)
        joint = np.stack(
            [
                float(w) * stats.multivariate_normal(mean, covariance).pdf(own)
                for w, mean, covariance in zip(mixture.weights, means, covariances, strict=True)
            ]
        )
        weights = (joint / joint.sum(axis=0)).mean(axis=1)
        mu0 = sum(w * mean for w, mean in zip(weights, means, strict=True))
        Phi = sum(
            w * (covariance + np.outer(mean - mu0, mean - mu0))
            for w, mean, covariance in zip(weights, means, covariances, strict=True)
        )
        m, n0 = 1.0, (P - 2 - D) / P
        mu = own.mean(axis=0)
        empirical = sum(np.outer(point - mu, point - mu) for point in own) / N
        shift = np.outer(mu - mu0, mu - mu0)
        Sigma = (N * empirical + Phi + N * m / (N + m) * shift) / (N + n0)
        xx = Sigma[:p, :p] + 1e-6 * np.diag(np.diag(Sigma)[:p])
        F = np.linalg.solve(xx, Sigma[:p, p:]).T
        # A ridge of a millionth of the variances pulls increments to zero here, and x' there.
        tolerance = 2e-6 * np.linalg.cond(xx)
        assert tolerance < 1e-3
        np.testing.assert_allclose(found.F[t], F, atol=tolerance)
        np.testing.assert_allclose(found.f[t], mu[p:] - F @ mu[:p], atol=tolerance)
        noise = Sigma[p:, p:] - F @ xx @ F.T
        np.testing.assert_allclose(found.Sigma[t], noise, rtol=1e-4, atol=5e-6)
