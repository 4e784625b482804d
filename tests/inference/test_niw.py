"""The NIW belief about the initial state against SciPy and textbook formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats

from solar_cli.inference import niw
from solar_cli.inference.mniw import RegressionStatistics
from solar_cli.inference.niw import NIW

STANDARD_ERRORS = 5


def belief(seed: int, d: int = 3) -> NIW:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(d, d + 2))
    Psi = root @ root.T / d + 0.2 * np.eye(d)
    parts = (Psi, np.float64(d + 4 + rng.uniform()), rng.normal(size=d), np.float64(0.7))
    return NIW(*map(torch.as_tensor, parts))


def sample(q: NIW, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    Sigma = stats.invwishart(float(q.nu), q.Psi.numpy()).rvs(n, random_state=rng).reshape(n, 3, 3)
    white = rng.normal(size=(n, q.mu0.shape[0], 1))
    root = np.linalg.cholesky(Sigma) / math.sqrt(q.kappa)
    return q.mu0.numpy() + (root @ white)[..., 0], Sigma


def log_density(q: NIW, mu: np.ndarray, Sigma: np.ndarray) -> float:
    location = stats.multivariate_normal(q.mu0.numpy(), Sigma / float(q.kappa))
    return stats.invwishart(float(q.nu), q.Psi.numpy()).logpdf(Sigma) + location.logpdf(mu)


def posterior(prior: NIW, statistics: RegressionStatistics) -> NIW:
    return niw.standard(niw.natural(prior).plus(statistics))


def assert_mean(samples: np.ndarray, expected: torch.Tensor) -> None:
    error = samples.std(0, ddof=1) / math.sqrt(len(samples))
    assert np.all(np.abs(samples.mean(0) - expected.numpy()) <= STANDARD_ERRORS * error)


def test_initial_state_parameters_convert_back_and_forth():
    q = belief(1)
    for part, back in zip(q, niw.standard(niw.natural(q)), strict=True):
        torch.testing.assert_close(back, part, rtol=1e-12, atol=1e-12)
    A, B, C, nu = niw.natural(q)
    torch.testing.assert_close(A, q.Psi + q.kappa * torch.outer(q.mu0, q.mu0))
    torch.testing.assert_close((C[0, 0], nu), (q.kappa, q.nu))
    torch.testing.assert_close(B[:, 0], q.kappa * q.mu0)


def test_initial_state_natural_parameters_give_the_density_up_to_its_constant():
    q, d = belief(2), 3
    A, B, C, nu = (part.numpy() for part in niw.natural(q))

    def constant(mu: np.ndarray, Sigma: np.ndarray) -> float:
        precision = np.linalg.inv(Sigma)
        inner = (
            -0.5 * np.trace(A @ precision)
            + B[:, 0] @ precision @ mu
            - 0.5 * C[0, 0] * mu @ precision @ mu
            - 0.5 * (nu + d + 2) * np.linalg.slogdet(Sigma)[1]
        )
        return inner - log_density(q, mu, Sigma)

    draws = zip(*sample(q, 5, np.random.default_rng(3)), strict=True)
    constants = [constant(mu, Sigma) for mu, Sigma in draws]
    assert constants == pytest.approx([constants[0]] * 5, abs=1e-9)


def test_initial_state_kl_divergence_is_the_mean_log_ratio():
    q, p = belief(4), belief(5)
    mu, Sigma = sample(q, 1_500, np.random.default_rng(6))
    ratio = [log_density(q, m, s) - log_density(p, m, s) for m, s in zip(mu, Sigma, strict=True)]
    assert_mean(np.array(ratio), niw.kl_divergence(q, p))


def test_initial_state_posterior_is_the_textbook_update():
    prior, rng = belief(7), np.random.default_rng(8)
    z, weights = rng.normal(size=(6, 3)), np.array([1.0, 1, 0, 2, 1, 1])
    counted = np.repeat(z, weights.astype(int), axis=0)
    n, mean = len(counted), counted.mean(0)
    kappa, gap = float(prior.kappa), mean - prior.mu0.numpy()
    scatter = (counted - mean).T @ (counted - mean)
    expected = (
        prior.Psi.numpy() + scatter + kappa * n / (kappa + n) * np.outer(gap, gap),
        float(prior.nu) + n,
        (kappa * prior.mu0.numpy() + n * mean) / (kappa + n),
        kappa + n,
    )
    data = niw.initial_statistics(torch.as_tensor(z), weights=torch.as_tensor(weights))
    for part, oracle in zip(posterior(prior, data), expected, strict=True):
        np.testing.assert_allclose(part.numpy(), oracle, rtol=1e-10, atol=1e-10)


def test_initial_state_closed_form_is_the_step_of_rate_one():
    prior, current = belief(9), belief(10)
    z = torch.as_tensor(np.random.default_rng(11).normal(size=(8, 3)))
    data = niw.initial_statistics(z, z_variance=torch.full_like(z, 0.1))
    step = niw.natural_gradient_step(niw.natural(current), niw.natural(prior), data, 1.0, 1.0)
    for part, expected in zip(niw.standard(step), posterior(prior, data), strict=True):
        torch.testing.assert_close(part, expected)


def test_expected_initial_kl_is_the_mean_divergence_and_differentiable():
    q, rng = belief(12), np.random.default_rng(13)
    mean, variance = rng.normal(size=3), rng.uniform(0.1, 1, 3)
    mu, Sigma = sample(q, 40_000, rng)
    P, error = np.linalg.inv(Sigma), mean - mu
    divergence = 0.5 * (
        np.einsum("nii,i->n", P, variance)
        + np.einsum("ni,nij,nj->n", error, P, error)
        - 3
        + np.linalg.slogdet(Sigma)[1]
        - np.log(variance).sum()
    )
    arguments = [torch.tensor(part, requires_grad=True) for part in (mean, variance)]

    def initial_kl(mean, variance):
        start = niw.initial_statistics(mean[None], variance[None])
        return niw.expected_initial_kl(niw.natural(q), start, variance.log().sum())

    assert_mean(divergence, initial_kl(*arguments).detach())
    assert torch.autograd.gradcheck(initial_kl, arguments)
