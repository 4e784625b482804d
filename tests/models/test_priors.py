"""Priors over latents against dense loops in the paper's letters, Monte Carlo, finite differences.

In the loops x_t = [z_t; a_t; 1], and z_t is a window of latents, the newest frame first.
"""

import math

import numpy as np
import pytest
import torch
from model_problems import made_up_segments, vector_task
from scipy import special, stats

from solar_cli.inference import niw
from solar_cli.models.priors import (
    BayesianLDS,
    Segments,
    StandardNormal,
    regressors,
    standard_normal_kl,
)
from solar_cli.settings.local import Dynamics

T, d, a = 6, 2, 1
every_form = pytest.mark.parametrize(
    ("factors", "rows", "window"),
    [
        (factors, rows, window)
        for factors in ("shared", "varying")
        for rows in ("newest", "all")
        for window in (1, 3)
    ],
)


def dynamics(factors="shared", rows="newest", window=1, **settings):
    task = vector_task(horizon=T, window=window, actions=a)
    return BayesianLDS(Dynamics(factors=factors, rows=rows, **settings), d, task, "cpu")


def whole_episodes(seed=0, count=5):
    return made_up_segments(seed, [0] * count, T + 1, d, a)


def transitions(segments, window, rows):
    """(segment, t, x, var x, y, var y) of every z_t -> z_{t+1} inside the segments."""
    mean, variance, actions, start = (part.numpy() for part in segments[:4])
    found = []
    for s in range(len(start)):
        for newest in range(window - 1, mean.shape[1] - 1):

            def block(values, at, s=s):
                return np.concatenate([values[s, at - back] for back in range(window)])

            action = actions[s, newest]
            x = np.concatenate([block(mean, newest), action, [1.0]])
            x_variance = np.concatenate([block(variance, newest), 0 * action, [0.0]])
            entries = d if rows == "newest" else window * d
            y = block(mean, newest + 1)[:entries]
            y_variance = block(variance, newest + 1)[:entries]
            found.append((s, start[s] + newest, x, x_variance, y, y_variance))
    return found


def bayesian_regression(samples, entries, size, settings):
    """Appendix B from the prior of Eq. 2: (Psi, nu, M, V) after (x, var x, y, var y)."""
    nu = entries + 2.0
    Psi = settings.prior_scale * (nu + entries + 1) * np.eye(entries)
    M, V_inverse = np.eye(entries, size), settings.prior_precision * np.eye(size)
    A, B, C = Psi + M @ V_inverse @ M.T, M @ V_inverse, V_inverse.copy()
    for x, x_variance, y, y_variance in samples:
        A = A + np.outer(y, y) + np.diag(y_variance)
        B = B + np.outer(y, x)
        C = C + np.outer(x, x) + np.diag(x_variance)
        nu += 1
    V = np.linalg.inv(C)
    return A - B @ V @ B.T, nu, B @ V, V


def expected_kl(belief, x, x_variance, y, y_variance):
    """E KL(N(y, diag var y) || N(F x, Sigma)) over q(F, Sigma) and q(x), term by term."""
    Psi, nu, M, V = belief
    entries = len(y)
    precision = nu * np.linalg.inv(Psi)
    log_det = entries * math.log(2) - np.linalg.slogdet(Psi)[1]
    log_det += sum(special.digamma((nu - i) / 2) for i in range(entries))
    yy = np.outer(y, y) + np.diag(y_variance)
    xx = np.outer(x, x) + np.diag(x_variance)
    FPF = M.T @ precision @ M + entries * V
    quadratic = np.trace(precision @ yy) - 2 * y @ precision @ M @ x + np.trace(FPF @ xx)
    log_likelihood = 0.5 * (log_det - quadratic - entries * math.log(2 * math.pi))
    entropy = 0.5 * (np.log(y_variance).sum() + entries * (1 + math.log(2 * math.pi)))
    return -entropy - log_likelihood


def initial_belief(segments, entries=d):
    """The NIW of Eq. 2 after the first latents: regression on the constant 1 alone."""
    Psi, nu = (entries + 2.0) * np.eye(entries), entries + 2.0
    A, B, C = Psi, np.zeros((entries, 1)), np.ones((1, 1))
    for s in range(len(segments.start)):
        if segments.start[s] == 0:
            y, variance = segments.mean[s, 0].numpy(), segments.variance[s, 0].numpy()
            A = A + np.outer(y, y) + np.diag(variance)
            B, C, nu = B + y[:, None], C + 1, nu + 1
    return A - B @ B.T / C, nu, B / C, 1 / C


def reach(length, window):
    """How many of the starts that a segment can have reach each time step; and their number."""
    starts = range(T + 2 - length)
    reached = [t for s in starts for t in range(s + window - 1, s + length - 1)]
    return [reached.count(t) for t in range(T)], len(starts)


def expected_total(prior_settings, learned_from, judged, window):
    """KL a frame of ``judged`` under factors that were conditioned on ``learned_from``."""
    rows = prior_settings.rows
    entries, size = d if rows == "newest" else window * d, window * d + a + 1
    data = transitions(learned_from, window, rows)
    initial = initial_belief(learned_from)
    reached, starts = reach(judged.mean.shape[1], window)
    total = 0.0
    for _, t, *sample in transitions(judged, window, rows):
        same = [s for _, u, *s in data if prior_settings.factors == "shared" or u == t]
        belief = bayesian_regression(same, entries, size, prior_settings)
        total += starts / reached[t] * expected_kl(belief, *sample)
    one, zero = np.ones(1), np.zeros(1)
    for s in range(len(judged.start)):
        if judged.start[s] == 0:
            y, variance = judged.mean[s, 0].numpy(), judged.variance[s, 0].numpy()
            total += starts * expected_kl(initial, one, zero, y, variance)
    return total / len(judged.start) / (T + 2 - window)


def kl(prior, segments):
    return prior.kl(prior.statistics(segments))


# The KL terms of the ELBO


@every_form
def test_kl_is_that_of_a_dense_loop(factors, rows, window):
    prior = dynamics(factors, rows, window)
    learned = whole_episodes(1)
    prior.conclude(learned)
    judged = made_up_segments(2, [0, 1, 0], T, d, a)
    expected = expected_total(prior.settings, learned, judged, window)
    assert float(kl(prior, judged)) == pytest.approx(expected, rel=1e-9)


def test_segments_inside_an_episode_have_no_initial_term():
    prior = dynamics()
    prior.conclude(whole_episodes(1))
    judged = made_up_segments(2, [1, 2], 4, d, a)
    expected = expected_total(prior.settings, whole_episodes(1), judged, 1)
    assert float(kl(prior, judged)) == pytest.approx(expected, rel=1e-9)


@every_form
@pytest.mark.parametrize("length", [4, 5, 7])
def test_segments_of_every_start_are_on_average_whole_episodes(factors, rows, window, length):
    prior, episodes = dynamics(factors, rows, window), whole_episodes(6)
    prior.conclude(whole_episodes(1))
    parts = []
    for start in range(T + 2 - length):
        frames, moves = slice(start, start + length), slice(start, start + length - 1)
        parts.append(
            Segments(
                episodes.mean[:, frames],
                episodes.variance[:, frames],
                episodes.actions[:, moves],
                episodes.start + start,
            )
        )
    found = [prior.statistics(part) for part in parts]
    whole = prior.statistics(episodes)
    for name in ("transitions", "starts"):
        for index, expected in enumerate(getattr(whole, name)):
            mean = sum(getattr(part, name)[index] for part in found) / len(parts)
            torch.testing.assert_close(mean, expected, rtol=1e-12, atol=1e-12)
    mean = sum(float(prior.kl(part)) for part in found) / len(parts)
    assert mean == pytest.approx(float(prior.kl(whole)), rel=1e-12)


def test_kl_is_a_mean_over_draws_of_dynamics_and_latents():
    prior, segments = dynamics(), made_up_segments(3, [0], 3, d, a)
    prior.conclude(whole_episodes(1))
    learned = whole_episodes(1)
    samples = [s for _, _, *s in transitions(learned, 1, "newest")]
    Psi, nu, M, V = bayesian_regression(samples, d, d + a + 1, prior.settings)
    Psi0, nu0, mu0, V0 = initial_belief(learned)
    rng, n = np.random.default_rng(4), 20_000
    Sigma = stats.invwishart(nu, Psi).rvs(n, random_state=rng)
    white = rng.normal(size=(n, d, d + a + 1))
    F = M + np.linalg.cholesky(Sigma) @ white @ np.linalg.cholesky(V).T
    Sigma0 = stats.invwishart(nu0, Psi0).rvs(n, random_state=rng)
    centre = np.linalg.cholesky(Sigma0 * V0) @ rng.normal(size=(n, d, 1)) + mu0
    # Of the five starts of a segment of three frames one reaches t = 0, and two reach t = 1.
    draws = 5 * _gaussian_kl(segments.mean[0, 0], segments.variance[0, 0], centre[..., 0], Sigma0)
    for t in range(2):
        mean, variance = segments.mean[0, t].numpy(), segments.variance[0, t].numpy()
        z = mean + np.sqrt(variance) * rng.normal(size=(n, d))
        x = np.concatenate([z, np.tile([*segments.actions[0, t], 1.0], (n, 1))], axis=1)
        predicted = np.einsum("nij,nj->ni", F, x)
        draws = draws + 5 / (t + 1) * _gaussian_kl(
            segments.mean[0, t + 1], segments.variance[0, t + 1], predicted, Sigma
        )
    draws = draws / (T + 1)
    error = draws.std() / math.sqrt(n)
    assert error < 0.02
    assert abs(draws.mean() - float(kl(prior, segments))) < 5 * error


def _gaussian_kl(mean, variance, centres, covariances):
    mean, variance = mean.numpy(), variance.numpy()
    precision = np.linalg.inv(covariances)
    shift = mean - centres
    return 0.5 * (
        np.einsum("nii,i->n", precision, variance)
        + np.einsum("ni,nij,nj->n", shift, precision, shift)
        - d
        + np.linalg.slogdet(covariances)[1]
        - np.log(variance).sum()
    )


@every_form
def test_gradients_are_those_of_finite_differences(factors, rows, window):
    prior = dynamics(factors, rows, window)
    prior.conclude(whole_episodes(1))
    judged = made_up_segments(2, [0, 1], window + 2, d, a)

    def total(mean, log_variance):
        return kl(prior, judged._replace(mean=mean, variance=log_variance.exp()))

    inputs = judged.mean.clone().requires_grad_(), judged.variance.log().requires_grad_()
    assert torch.autograd.gradcheck(total, inputs)


def test_latents_that_follow_the_dynamics_cost_less_than_others():
    prior = dynamics()
    rng = np.random.default_rng(5)
    z = np.empty((40, T + 1, d))
    actions = rng.normal(size=(40, T, a))
    z[:, 0] = rng.normal(size=(40, d))
    for t in range(T):
        z[:, t + 1] = z[:, t] @ [[0.9, 0.2], [-0.2, 0.9]] + actions[:, t] * 0.5
    segments = Segments(
        torch.as_tensor(z),
        torch.full((40, T + 1, d), 1e-4).double(),
        torch.as_tensor(actions),
        torch.zeros(40, dtype=torch.long),
    )
    prior.conclude(segments)
    shuffled = segments._replace(actions=segments.actions.flip(0))
    assert float(kl(prior, segments)) < float(kl(prior, shuffled)) - 1.0


# Learning the factors


@every_form
def test_a_full_step_on_all_data_is_the_closed_form(factors, rows, window):
    closed, stepped = (dynamics(factors, rows, window, rate=1.0) for _ in range(2))
    segments = whole_episodes(1)
    closed.conclude(segments)
    stepped.learn(
        stepped.statistics(whole_episodes(7)), 3.0
    )  # a full step forgets where it came from
    stepped.learn(stepped.statistics(segments), 1.0)
    for left, right in zip(
        (*stepped.factor, *stepped.initial), (*closed.factor, *closed.initial), strict=True
    ):
        torch.testing.assert_close(left, right, rtol=1e-12, atol=1e-12)


@every_form
def test_what_is_given_episodes_alone_forgets_all_others(factors, rows, window):
    prior, closed = dynamics(factors, rows, window), dynamics(factors, rows, window)
    prior.conclude(whole_episodes(7))
    before = prior.state_dict()
    closed.conclude(whole_episodes(1))
    for left, right in zip(prior.given(whole_episodes(1)), closed.factor, strict=True):
        torch.testing.assert_close(left, right, rtol=0, atol=0)
    for left, right in zip(prior.factor, before["factor"], strict=True):
        assert torch.equal(left, right)


def test_without_the_closed_form_a_training_ends_with_one_more_step():
    stepped, ended = (dynamics(closed_form=False, rate=0.3) for _ in range(2))
    stepped.learn(stepped.statistics(whole_episodes(1)), 1.0)
    ended.conclude(whole_episodes(1))
    for left, right in zip(
        (*stepped.factor, *stepped.initial), (*ended.factor, *ended.initial), strict=True
    ):
        assert torch.equal(left, right)


def test_steps_of_a_small_rate_close_the_gap_geometrically():
    rate, steps = 0.3, 7
    stepped, closed = dynamics(rate=rate), dynamics()
    segments = whole_episodes(1)
    closed.conclude(segments)
    for _ in range(steps):
        stepped.learn(stepped.statistics(segments), 1.0)
    for now, target, start in zip(stepped.factor, closed.factor, stepped.prior, strict=True):
        expected = target + (1 - rate) ** steps * (start - target)
        torch.testing.assert_close(now, expected, rtol=1e-10, atol=1e-10)


def test_the_scale_counts_episodes():
    stepped, many = dynamics(rate=1.0), dynamics()
    segments = whole_episodes(1)
    stepped.learn(stepped.statistics(segments), 3.0)
    many.conclude(Segments(*(torch.cat([part] * 3) for part in segments[:4])))
    for left, right in zip(
        (*stepped.factor, *stepped.initial), (*many.factor, *many.initial), strict=True
    ):
        torch.testing.assert_close(left, right, rtol=1e-12, atol=1e-12)


@every_form
def test_factors_are_bayesian_regressions(factors, rows, window):
    """Time-varying factors equal separate fits a time step; a shared one is fitted to all."""
    prior = dynamics(factors, rows, window)
    segments = whole_episodes(1)
    prior.conclude(segments)
    data = transitions(segments, window, rows)
    entries, size = d if rows == "newest" else window * d, window * d + a + 1
    for t in range(T):
        samples = [s for _, u, *s in data if factors == "shared" or u == t]
        Psi, nu, M, V = bayesian_regression(samples, entries, size, prior.settings)
        factor = prior.factor
        if factors == "varying":
            factor = type(factor)(*(part[t] for part in factor))
        np.testing.assert_allclose(factor.n, nu)
        np.testing.assert_allclose(factor.xx, np.linalg.inv(V), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(factor.yx, M @ np.linalg.inv(V), rtol=1e-9, atol=1e-9)
        left = M @ np.linalg.inv(V) @ M.T
        np.testing.assert_allclose(factor.yy, Psi + left, rtol=1e-9, atol=1e-9)


def test_the_initial_factor_is_learned_from_starts_of_episodes():
    prior, segments = dynamics(), whole_episodes(8)
    prior.conclude(segments)
    Psi, nu, mu, inverse_kappa = initial_belief(segments)
    found = prior.initial
    np.testing.assert_allclose(found.n, nu)
    assert nu == d + 2 + 5
    np.testing.assert_allclose(found.xx, 1 / inverse_kappa)
    np.testing.assert_allclose(found.yx / found.xx, mu, rtol=1e-12)
    np.testing.assert_allclose(found.yy - found.yx @ found.yx.mT / found.xx, Psi, rtol=1e-12)


@pytest.mark.parametrize("window", [1, 3])
def test_the_newest_rows_are_rows_of_the_whole(window):
    newest, whole = dynamics(rows="newest", window=window), dynamics(rows="all", window=window)
    segments = whole_episodes(1)
    newest.conclude(segments)
    whole.conclude(segments)
    data, every = (
        [now - before for now, before in zip(p.factor, p.prior, strict=True)]
        for p in (newest, whole)
    )
    torch.testing.assert_close(data[0], every[0][:d, :d])
    torch.testing.assert_close(data[1], every[1][:d])
    torch.testing.assert_close(data[2], every[2])
    torch.testing.assert_close(data[3], every[3])
    assert every[0].shape == (window * d, window * d)


def test_windows_have_the_newest_frame_first():
    codes = torch.arange(5).double()[None, :, None] + torch.tensor([0.0, 0.5]).double()
    found = regressors(codes, 3)
    assert found.shape == (1, 3, 6)
    assert found[0, 0].tolist() == [2.0, 2.5, 1.0, 1.5, 0.0, 0.5]
    assert found[0, 2].tolist() == [4.0, 4.5, 3.0, 3.5, 2.0, 2.5]


@every_form
def test_a_prior_survives_its_state(factors, rows, window):
    prior, fresh = (dynamics(factors, rows, window) for _ in range(2))
    prior.learn(prior.statistics(whole_episodes(1)), 2.0)
    fresh.load_state_dict(prior.state_dict())
    judged = whole_episodes(3)
    assert float(kl(fresh, judged)) == float(kl(prior, judged))
    assert fresh.metrics() == prior.metrics()


def test_before_any_data_the_factors_are_the_prior():
    prior = dynamics()
    assert prior.metrics()["kl_dynamics"] == pytest.approx(0.0, abs=1e-9)
    assert prior.metrics()["kl_initial"] == pytest.approx(0.0, abs=1e-9)
    prior.conclude(whole_episodes(1))
    assert prior.metrics()["kl_dynamics"] > 1.0
    assert prior.metrics()["kl_initial"] > 0.1


@every_form
def test_a_latent_that_never_changes_breaks_neither_factor(factors, rows, window):
    segments = whole_episodes(1, count=40)
    segments.mean[..., 1] = 3.0
    segments.variance[..., 1] = 1e-7
    segments.mean.requires_grad_()
    prior = dynamics(factors, rows, window)
    prior.conclude(segments)
    total = kl(prior, segments)
    (gradient,) = torch.autograd.grad(total, segments.mean)
    assert torch.isfinite(gradient).all()
    assert all(math.isfinite(value) for value in (total.item(), *prior.metrics().values()))
    # Its start is known: the prior's one sample at 0 counts beside the 40 at 3.
    assert float(niw.standard(prior.initial).mu0[1]) == pytest.approx(3.0 * 40 / 41)


# The VAE's


def test_the_standard_normal_is_torch_distributions():
    segments = whole_episodes(1)
    factor = torch.distributions.Normal(segments.mean, segments.variance.sqrt())
    normal = torch.distributions.Normal(torch.zeros(()).double(), torch.ones(()).double())
    expected = torch.distributions.kl_divergence(factor, normal).sum(dim=-1)
    torch.testing.assert_close(standard_normal_kl(segments.mean, segments.variance), expected)
    torch.testing.assert_close(kl(StandardNormal(), segments), expected.mean())


def test_the_standard_normal_knows_no_dynamics():
    prior, segments = StandardNormal(), whole_episodes(1)
    before = float(kl(prior, segments))
    prior.learn(prior.statistics(segments), 1.0)
    prior.conclude(segments)
    assert prior.factor is None
    assert prior.given(segments) is None
    assert float(kl(prior, segments)) == before
    assert prior.state_dict() == prior.metrics() == {}


def test_only_rce_has_networks_of_its_own():
    for prior in (StandardNormal(), dynamics()):
        assert prior.transition is None
        assert list(prior.parameters()) == []
        assert prior.judged(prior.statistics(whole_episodes(1))) == {}
