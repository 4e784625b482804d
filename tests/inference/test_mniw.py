"""The MNIW belief against SciPy's densities and samplers, brute force, and quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats

from solar_cli.inference import mniw
from solar_cli.inference.mniw import MNIW, RegressionStatistics

STANDARD_ERRORS = 5  # a correct mean is farther off once in two million checks


def belief(seed: int, d: int = 2, p: int = 3, batch: tuple[int, ...] = ()) -> MNIW:
    rng = np.random.default_rng(seed)

    def definite(size: int) -> np.ndarray:
        root = rng.normal(size=(*batch, size, size + 2))
        return root @ root.swapaxes(-1, -2) / size + 0.2 * np.eye(size)

    nu = d + 4 + rng.uniform(0, 6, size=batch)
    return MNIW(
        *map(torch.as_tensor, (definite(d), nu, rng.normal(size=(*batch, d, p)), definite(p)))
    )


def pairs(seed: int, n: int, d: int = 2, p: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    return torch.as_tensor(rng.normal(size=(n, p))), torch.as_tensor(rng.normal(size=(n, d)))


def sample(q: MNIW, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """n draws of (F, S) by SciPy's inverse-Wishart."""
    d, p = q.M.shape
    S = stats.invwishart(float(q.nu), q.Psi.numpy()).rvs(n, random_state=rng).reshape(n, d, d)
    white = rng.normal(size=(n, d, p))
    F = q.M.numpy() + np.linalg.cholesky(S) @ white @ np.linalg.cholesky(q.V.numpy()).T
    return F, S


def log_density(q: MNIW, F: np.ndarray, S: np.ndarray) -> float:
    columns = stats.matrix_normal(q.M.numpy(), S, q.V.numpy())
    return stats.invwishart(float(q.nu), q.Psi.numpy()).logpdf(S) + columns.logpdf(F)


def posterior(prior: MNIW, statistics: RegressionStatistics) -> MNIW:
    return mniw.standard(mniw.natural(prior).plus(statistics))


def log_evidence(prior: MNIW, X: np.ndarray, Y: np.ndarray) -> float:
    """log p(Y | X), pair by pair: each is a multivariate t given those before, by SciPy."""
    Psi, nu, M, V = (part.numpy() for part in prior)
    evidence = 0.0
    for x, y in zip(X, Y, strict=True):
        spread, error, dof = 1 + x @ V @ x, y - M @ x, nu - len(y) + 1
        predictive = stats.multivariate_t(M @ x, Psi * spread / dof, df=float(dof))
        evidence += float(predictive.logpdf(y))
        gain = V @ x / spread  # a rank-one update, as in recursive least squares
        M, V = M + np.outer(error, gain), V - np.outer(gain, x @ V)
        Psi, nu = Psi + np.outer(error, error) / spread, nu + 1
    return evidence


def assert_mean(samples: np.ndarray, expected: torch.Tensor) -> None:
    error = samples.std(0, ddof=1) / math.sqrt(len(samples))
    assert np.all(np.abs(samples.mean(0) - expected.numpy()) <= STANDARD_ERRORS * error)


def assert_same(a: tuple, b: tuple, rtol: float = 1e-9, atol: float = 1e-9) -> None:
    for left, right in zip(a, b, strict=True):
        torch.testing.assert_close(left, right, rtol=rtol, atol=atol)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    d=st.integers(1, 5),
    p=st.integers(1, 6),
    latent_scale=st.floats(-3, 3),
    noise_scale=st.floats(-6, 2),
)
def test_natural_and_standard_parameters_are_inverse_to_each_other(
    seed, d, p, latent_scale, noise_scale
):
    q = belief(seed, d, p)
    q = q._replace(V=q.V * 10**latent_scale, Psi=q.Psi * 10**noise_scale)
    back = mniw.standard(mniw.natural(q))
    # Psi is a difference of terms as large as M V^-1 M^T: its digits are relative to those.
    size = float((q.M @ torch.linalg.inv(q.V) @ q.M.mT).abs().max())
    torch.testing.assert_close(back.Psi, q.Psi, rtol=1e-9, atol=1e-12 * size)
    assert_same((back.nu, back.M, back.V / q.V.abs().max()), (q.nu, q.M, q.V / q.V.abs().max()))


def test_natural_parameters_give_the_density_up_to_its_constant():
    q, rng = belief(1), np.random.default_rng(2)
    d, p = q.M.shape
    A, B, C, nu = (part.numpy() for part in mniw.natural(q))

    def constant(F: np.ndarray, S: np.ndarray) -> float:
        precision = np.linalg.inv(S)
        inner = (
            -0.5 * np.trace(A @ precision)
            + np.trace(B.T @ precision @ F)
            - 0.5 * np.trace(C @ F.T @ precision @ F)
            - 0.5 * (nu + d + p + 1) * np.linalg.slogdet(S)[1]
        )
        return inner - log_density(q, F, S)

    constants = [constant(F, S) for F, S in zip(*sample(q, 5, rng), strict=True)]
    assert constants == pytest.approx([constants[0]] * 5, abs=1e-9)


def test_expected_statistics_are_means_over_samples():
    q = belief(3)
    F, S = sample(q, 40_000, np.random.default_rng(4))
    P = np.linalg.inv(S)
    expected = mniw.expected_statistics(mniw.natural(q))
    assert_mean(P, expected.precision)
    assert_mean(P @ F, expected.precision_F)
    assert_mean(F.swapaxes(1, 2) @ P @ F, expected.F_precision_F)
    assert_mean(np.linalg.slogdet(P)[1], expected.log_det_precision)


def test_kl_divergence_is_the_mean_log_ratio_over_samples():
    q, p = belief(5), belief(6)
    F, S = sample(q, 1_500, np.random.default_rng(7))
    ratio = np.array(
        [log_density(q, f, s) - log_density(p, f, s) for f, s in zip(F, S, strict=True)]
    )
    assert_mean(ratio, mniw.kl_divergence(q, p))
    assert float(mniw.kl_divergence(q, q)) == pytest.approx(0, abs=1e-12)


def test_members_keep_what_is_of_all_of_them():
    yy, n = torch.eye(2).double(), torch.tensor(3.0).double()
    yx, xx = torch.randn(2, 5, 2, 3).double(), torch.randn(5, 3, 3).double()
    some = RegressionStatistics(yy, yx, xx, n).at(torch.tensor([4, 0]))
    assert torch.equal(some.yy, yy)
    assert torch.equal(some.n, n)
    assert torch.equal(some.yx, torch.stack([yx[:, 4], yx[:, 0]], dim=1))
    assert torch.equal(some.xx, torch.stack([xx[4], xx[0]]))


def test_posterior_is_batch_bayesian_regression():
    prior, (x, y) = belief(8), pairs(9, 20)
    X, Y = x.numpy(), y.numpy()
    M0, V0, Psi0 = prior.M.numpy(), prior.V.numpy(), prior.Psi.numpy()
    V = np.linalg.inv(np.linalg.inv(V0) + sum(np.outer(row, row) for row in X))
    moment = sum(np.outer(b, a) for a, b in zip(X, Y, strict=True))
    M = (M0 @ np.linalg.inv(V0) + moment) @ V
    # Residuals of the data and of the prior's pseudo-data, instead of a difference of squares.
    Psi = Psi0 + (Y - X @ M.T).T @ (Y - X @ M.T) + (M - M0) @ np.linalg.inv(V0) @ (M - M0).T
    q = posterior(prior, mniw.regression_statistics(x, y))
    assert_same(q, tuple(map(torch.as_tensor, (Psi, prior.nu + 20, M, V))))


def test_posterior_after_two_halves_is_the_posterior_after_all():
    prior, (x, y) = belief(10), pairs(11, 14)
    half = posterior(prior, mniw.regression_statistics(x[:7], y[:7]))
    both = posterior(half, mniw.regression_statistics(x[7:], y[7:]))
    assert_same(both, posterior(prior, mniw.regression_statistics(x, y)))


def test_uncentred_narrow_latents_leave_the_noise_recoverable():
    """Latents of std 0.05 around 1 under noise of variance 1e-4, which float32 cannot resolve."""
    rng = np.random.default_rng(12)
    x = 1 + 0.05 * rng.normal(size=(2_000, 6))
    y = x[:, :4] + 0.01 * rng.normal(size=(2_000, 4))
    eye = torch.eye(6, dtype=torch.float64)
    nothing = torch.zeros(4, 6, dtype=torch.float64)
    prior = MNIW(1e-6 * eye[:4, :4], torch.tensor(6.0).double(), nothing, 1e6 * eye)
    data = mniw.regression_statistics(torch.as_tensor(x), torch.as_tensor(y))
    _, Sigma = mniw.point_estimate(mniw.natural(prior).plus(data))
    # Eigenvalues of a Wishart of n samples spread by about 2 sqrt(d/n) = 9 %.
    assert torch.all((torch.linalg.eigvalsh(Sigma) / 1e-4 - 1).abs() < 0.2)


def test_closed_form_is_the_natural_gradient_step_of_rate_one_on_the_full_batch():
    prior, current, (x, y) = belief(13), belief(14), pairs(15, 30)
    data = mniw.regression_statistics(x, y)
    step = mniw.natural_gradient_step(mniw.natural(current), mniw.natural(prior), data, 1.0, 1.0)
    assert_same(mniw.standard(step), posterior(prior, data))


def test_natural_gradient_steps_of_minibatches_average_to_the_full_step():
    prior, current, (x, y) = (*map(mniw.natural, map(belief, (16, 17))), pairs(18, 12))
    full = mniw.natural_gradient_step(
        current, prior, mniw.regression_statistics(x, y), scale=1.0, rate=0.3
    )
    parts = [
        mniw.natural_gradient_step(
            current, prior, mniw.regression_statistics(a, b), scale=4.0, rate=0.3
        )
        for a, b in zip(x.split(3), y.split(3), strict=True)
    ]
    mean = RegressionStatistics(*(torch.stack(field).mean(0) for field in zip(*parts, strict=True)))
    assert_same(mean, full)


def test_elbo_at_the_posterior_is_the_evidence():
    prior, (x, y) = belief(26), pairs(27, 9)
    data = mniw.regression_statistics(x, y)
    q = posterior(prior, data)
    e = mniw.expected_statistics(mniw.natural(q))
    fit = (
        -0.5 * (e.precision * data.yy).sum()
        + (e.precision_F * data.yx).sum()
        - 0.5 * (e.F_precision_F * data.xx).sum()
        + 0.5 * data.n * (e.log_det_precision - 2 * math.log(2 * math.pi))
    )
    elbo = fit - mniw.kl_divergence(q, prior)
    assert float(elbo) == pytest.approx(log_evidence(prior, x.numpy(), y.numpy()), abs=1e-9)


def test_expected_transition_kl_is_the_mean_divergence_over_samples():
    q, rng = belief(28), np.random.default_rng(29)
    n = 40_000
    y_mean, y_variance = rng.normal(size=2), rng.uniform(0.1, 1, 2)
    x_mean, x_variance = rng.normal(size=3), np.array([0.3, 0.7, 0.0])
    F, S = sample(q, n, rng)
    x = x_mean + np.sqrt(x_variance) * rng.normal(size=(n, 3))
    error = y_mean - np.einsum("nij,nj->ni", F, x)
    P = np.linalg.inv(S)
    divergence = 0.5 * (
        np.einsum("nii,i->n", P, y_variance)
        + np.einsum("ni,nij,nj->n", error, P, error)
        - 2
        + np.linalg.slogdet(S)[1]
        - np.log(y_variance).sum()
    )
    assert_mean(divergence, transition_kl(q, y_mean, y_variance, x_mean, x_variance))


def transition_kl(q, y_mean, y_variance, x_mean, x_variance):
    """Of one pair."""
    y, y_var, x, x_var = (
        torch.as_tensor(part)[..., None, :] for part in (y_mean, y_variance, x_mean, x_variance)
    )
    pair = mniw.regression_statistics(x, y, x_var, y_var)
    expected = mniw.expected_statistics(mniw.natural(q))
    return mniw.expected_transition_kl(expected, pair, y_var.log().sum((-2, -1)))


def test_expected_transition_kl_is_a_sum_over_pairs():
    q, rng = belief(28), np.random.default_rng(30)
    parts = [torch.as_tensor(rng.uniform(0.2, 1, size=(5, size))) for size in (2, 2, 3, 3)]
    y, y_variance, x, x_variance = parts
    weights = torch.tensor([1.0, 2.0, 0.0, 0.5, 1.0]).double()
    pairs = mniw.regression_statistics(x, y, x_variance, y_variance, weights)
    logs = (weights * y_variance.log().sum(dim=-1)).sum()
    together = mniw.expected_transition_kl(mniw.expected_statistics(mniw.natural(q)), pairs, logs)
    apart = torch.stack([transition_kl(q, *(part[i] for part in parts)) for i in range(5)])
    torch.testing.assert_close(together, (weights * apart).sum(), rtol=1e-12, atol=1e-12)


def test_expected_transition_kl_has_the_gradients_of_finite_differences():
    q, rng = belief(30, batch=(4,)), np.random.default_rng(31)
    arguments = [
        torch.tensor(rng.uniform(0.2, 1, size=(5, 4, size)), requires_grad=True)
        for size in (2, 2, 3, 3)
    ]
    assert torch.autograd.gradcheck(lambda *a: transition_kl(q, *a), arguments, eps=1e-6, atol=1e-6)


def test_beliefs_of_time_steps_broadcast_against_samples():
    q = belief(32, batch=(4,))
    rng = np.random.default_rng(33)
    x, y = (torch.as_tensor(rng.uniform(0.5, 1, size=(5, 4, size))) for size in (3, 2))
    together = transition_kl(q, y, y, x, x)
    for t in range(4):
        single = MNIW(*(part[t] for part in q))
        for n in range(5):
            a, b = x[n, t], y[n, t]
            apart = transition_kl(single, b, b, a, a)
            torch.testing.assert_close(apart, together[n, t], rtol=1e-9, atol=1e-9)


def test_statistics_of_uncertain_pairs_are_means_over_their_samples():
    rng = np.random.default_rng(34)
    (x, y), (x_variance, y_variance) = pairs(35, 4), (rng.uniform(size=(4, 3)), np.ones((4, 2)))
    n = 20_000
    xs = x.numpy() + np.sqrt(x_variance) * rng.normal(size=(n, 4, 3))
    ys = y.numpy() + rng.normal(size=(n, 4, 2))
    expected = mniw.regression_statistics(
        x, y, torch.as_tensor(x_variance), torch.as_tensor(y_variance)
    )
    assert_mean(np.einsum("sni,snj->sij", xs, xs), expected.xx)
    assert_mean(np.einsum("sni,snj->sij", ys, xs), expected.yx)
    assert_mean(np.einsum("sni,snj->sij", ys, ys), expected.yy)
    assert float(expected.n) == 4


def test_a_weight_counts_a_pair_that_many_times():
    x, y = pairs(36, 5)
    variance = torch.ones_like(x)
    weights = torch.tensor([2.0, 0.0, 1.0, 3.0, 1.0])
    rows = torch.tensor([0, 0, 2, 3, 3, 3, 4])
    weighted = mniw.regression_statistics(x, y, x_variance=variance, weights=weights)
    repeated = mniw.regression_statistics(x[rows], y[rows], x_variance=variance[rows])
    assert_same(weighted, repeated)
    doubled = mniw.regression_statistics(x, y)
    assert_same(doubled.scaled(2.0), doubled.plus(doubled))


def test_scaling_by_a_weight_a_time_step_scales_each_alone():
    x, y = pairs(37, 12)
    steps = mniw.regression_statistics(x.reshape(3, 4, 3), y.reshape(3, 4, 2))
    scaled = steps.scaled(torch.tensor([0.5, 1.0, 4.0]))
    for t, weight in enumerate((0.5, 1.0, 4.0)):
        alone = mniw.regression_statistics(x[4 * t : 4 * t + 4], y[4 * t : 4 * t + 4])
        assert_same(tuple(part[t] for part in scaled), alone.scaled(weight))


@pytest.mark.parametrize("constant", [0, 2, -1])
def test_centred_statistics_are_those_of_demeaned_pairs(constant):
    x, y = pairs(38, 9)
    with_constant = x.clone()
    with_constant[:, constant] = 1
    slopes = np.delete(x.numpy(), constant, axis=1)
    demeaned = mniw.regression_statistics(
        torch.as_tensor(slopes - slopes.mean(0)), torch.as_tensor(y.numpy() - y.numpy().mean(0))
    )
    centred = mniw.centred(mniw.regression_statistics(with_constant, y), constant)
    assert_same(centred, demeaned._replace(n=demeaned.n - 1))


def test_centring_integrates_the_intercept_out():
    """As a function of (F, S) the likelihood of the centred statistics is the integral over b."""
    x, y = (column.numpy()[:, 0] for column in pairs(39, 5, d=1, p=1))
    augmented = torch.as_tensor(np.stack([x, np.ones(5)], 1))
    data = mniw.centred(mniw.regression_statistics(augmented, torch.as_tensor(y)[:, None]), 1)

    def integrated(F: float, S: float) -> float:
        def likelihood(b: float) -> float:
            return float(np.prod(stats.norm.pdf(y, F * x + b, math.sqrt(S))))

        return math.log(integrate.quad(likelihood, -20, 20, points=[0], epsabs=0)[0])

    def centred(F: float, S: float) -> float:
        square = float(data.yy - 2 * F * data.yx + F * F * data.xx)
        return -0.5 * (square / S + float(data.n) * math.log(S))

    points = [(0.0, 1.0), (0.7, 0.4), (-1.0, 2.5)]
    gaps = [integrated(*point) - centred(*point) for point in points]
    assert gaps == pytest.approx([gaps[0]] * 3, abs=1e-6)


def test_centring_a_time_step_without_data_leaves_it_empty():
    x, y = pairs(40, 4)
    x[:, -1] = 1
    weights = torch.tensor([[1.0, 1, 1, 1], [0, 0, 0, 0]])
    batch = mniw.regression_statistics(x.expand(2, 4, 3), y.expand(2, 4, 2), weights=weights)
    centred = mniw.centred(batch, -1)
    assert all(torch.all(part[1] == 0) for part in centred)
    assert float(centred.n[0]) == 3


def test_point_estimate_inverts_the_expected_precision():
    q = belief(41, batch=(3,))
    parameters = mniw.natural(q)
    F, Sigma = mniw.point_estimate(parameters)
    expected = mniw.expected_statistics(parameters).precision
    assert_same((F, torch.linalg.inv(Sigma)), (q.M, expected))


def test_parameters_that_are_no_belief_raise():
    bad = mniw.natural(belief(42))
    with pytest.raises(torch.linalg.LinAlgError):
        mniw.standard(bad._replace(yy=-bad.yy))
