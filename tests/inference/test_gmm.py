"""EM and the mixture prior of LQR-FLM against known clusters, SciPy densities and least squares."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from solar_cli.inference import gmm
from solar_cli.inference.gmm import LocalPrior


def clusters(seed: int = 0, n: int = 600) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of three well separated, correlated clusters; their means and weights."""
    rng = np.random.default_rng(seed)
    means = np.array([[0.0, 0.0], [6.0, 0.0], [0.0, 8.0]])
    weights = np.array([0.5, 0.3, 0.2])
    label = rng.choice(3, size=n, p=weights)
    root = np.array([[1.0, 0.0], [0.6, 0.5]])
    return means[label] + rng.normal(size=(n, 2)) @ root.T, means, weights


def test_expectation_maximisation_recovers_known_clusters():
    points, means, weights = clusters()
    mixture = gmm.fit_mixture(torch.as_tensor(points), 3, np.random.default_rng(1)).mixture
    order = [int((mixture.means.numpy() - mean).__pow__(2).sum(1).argmin()) for mean in means]
    assert sorted(order) == [0, 1, 2]
    # Four standard errors of a cluster of at least 100 points; covariance [[1, .6], [.6, .61]].
    np.testing.assert_allclose(mixture.means[order], means, atol=0.4)
    np.testing.assert_allclose(mixture.weights[order], weights, atol=0.08)
    covariance = np.tile([[1.0, 0.6], [0.6, 0.61]], (3, 1, 1))
    np.testing.assert_allclose(mixture.covariances[order], covariance, atol=0.4)


@pytest.mark.parametrize("seed", range(4))
def test_log_posterior_never_falls(seed):
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.normal(size=(80, 4)), rng.uniform(-3, 3, size=(80, 4))])
    fit = gmm.fit_mixture(torch.as_tensor(points), 5, np.random.default_rng(seed))
    gain = np.diff(fit.log_posterior)
    assert len(gain) > 3
    assert np.all(gain >= -1e-9 * np.abs(fit.log_posterior[:-1]))


def test_log_posterior_is_the_log_likelihood_but_for_the_weak_prior():
    points, *_ = clusters()
    fit = gmm.fit_mixture(torch.as_tensor(points), 3, np.random.default_rng(1))
    density = sum(
        float(w) * stats.multivariate_normal(mean.numpy(), cov.numpy()).pdf(points)
        for w, mean, cov in zip(*fit.mixture[:3], strict=True)
    )
    # The prior's term is 3e-4 x the traces of (data variance) x (cluster precision), some 50 each.
    assert fit.log_posterior[-1] == pytest.approx(np.log(density).sum(), abs=0.1)


def test_one_cluster_is_the_data_s_gaussian_with_its_variances_barely_weighted_up():
    points = clusters()[0]
    mixture = gmm.fit_mixture(torch.as_tensor(points), 1, np.random.default_rng(1)).mixture
    covariance = np.cov(points.T, bias=True)
    expected = (covariance + 1e-6 * np.diag(np.diag(covariance))) / (1 + 1e-6)
    np.testing.assert_allclose(mixture.means[0], points.mean(0), rtol=1e-12)
    np.testing.assert_allclose(mixture.covariances[0], expected, rtol=1e-10)


def test_same_generator_gives_the_same_mixture():
    points = torch.as_tensor(clusters()[0])
    first, second = (gmm.fit_mixture(points, 4, np.random.default_rng(3)).mixture for _ in "ab")
    assert all(torch.equal(a, b) for a, b in zip(first[:3], second[:3], strict=True))


def test_a_shift_changes_no_responsibility():
    """Squares of 1e5 have 11 digits before those that matter."""
    points = torch.as_tensor(clusters()[0])
    same = [
        gmm.responsibilities(gmm.fit_mixture(x, 4, np.random.default_rng(4)).mixture, x)
        for x in (points, points + 1e5)
    ]
    torch.testing.assert_close(same[0], same[1], rtol=0, atol=1e-7)


def test_a_change_of_units_changes_no_responsibility():
    points = torch.as_tensor(clusters()[0])
    scale = torch.tensor([2.0**-13, 2.0**17], dtype=torch.float64)  # exact in binary
    same = [
        gmm.responsibilities(gmm.fit_mixture(x, 4, np.random.default_rng(4)).mixture, x)
        for x in (points, points * scale)
    ]
    torch.testing.assert_close(same[0], same[1], rtol=1e-9, atol=1e-9)


def test_constant_and_repeated_points_do_not_break_the_fit():
    points = torch.zeros(50, 3, dtype=torch.float64)
    points[:, 0] = torch.arange(50) % 2
    fit = gmm.fit_mixture(points, 3, np.random.default_rng(5))
    still = gmm.fit_mixture(torch.ones(50, 3), 2, np.random.default_rng(6))
    for mixture in (fit.mixture, still.mixture):
        assert all(torch.isfinite(part).all() for part in mixture[:3])


@pytest.mark.parametrize(("points", "expected"), [(10, 2), (400, 10), (100_000, 20)])
def test_cluster_count_is_one_for_forty_points(points, expected):
    assert gmm.cluster_count(points) == expected


def test_local_prior_has_the_moments_of_the_clusters_at_its_points():
    points = clusters()[0].reshape(6, 100, 2)
    mixture = gmm.fit_mixture(
        torch.as_tensor(points.reshape(-1, 2)), 3, np.random.default_rng(7)
    ).mixture
    prior = gmm.local_prior(mixture, torch.as_tensor(points))
    for t in range(6):
        joint = np.stack(
            [
                float(w) * stats.multivariate_normal(m.numpy(), c.numpy()).pdf(points[t])
                for w, m, c in zip(*mixture[:3], strict=True)
            ],
            axis=1,
        )
        weight = (joint / joint.sum(1, keepdims=True)).mean(0)
        second = sum(
            w * (c.numpy() + np.outer(m, m))
            for w, m, c in zip(weight, mixture.means.numpy(), mixture.covariances, strict=True)
        )
        mean = weight @ mixture.means.numpy()
        np.testing.assert_allclose(prior.mu0[t], mean, atol=1e-9)
        np.testing.assert_allclose(prior.Phi[t], second - np.outer(mean, mean), atol=1e-9)
    assert (prior.m, prior.n0) == (1.0, (600 - 2 - 2) / 600)


def test_joint_fit_shrinks_the_scatter_towards_the_prior():
    points = np.random.default_rng(8).normal(size=(1, 5, 3))
    mu0, Phi = np.array([1.0, 0, -1]), 2 * np.eye(3)
    prior = LocalPrior(torch.as_tensor(mu0)[None], torch.as_tensor(Phi)[None], m=1.0, n0=0.9)
    mean, covariance = gmm.fit_joint(torch.as_tensor(points), prior)
    centre = points[0].mean(0)
    empirical = np.cov(points[0].T, bias=True)
    shift = np.outer(centre - mu0, centre - mu0)
    expected = (5 * empirical + Phi + 5 / 6 * shift) / 5.9
    np.testing.assert_allclose(mean[0], centre, atol=1e-12)
    np.testing.assert_allclose(covariance[0], expected, atol=1e-12)


def test_joint_fit_is_the_scatter_of_real_and_imagined_points():
    """The prior as what it stands for: m points with mean mu0 and scatter Phi."""
    rng = np.random.default_rng(11)
    points, mu0, m, n0 = rng.normal(size=(7, 3)), rng.normal(size=3), 2.5, 1.75
    root = rng.normal(size=(3, 3))
    Phi = root @ root.T
    arms = np.sqrt(3 / m) * root.T
    imagined = mu0 + np.concatenate([arms, -arms])
    everything = np.concatenate([points, imagined])
    weight = np.concatenate([np.ones(7), np.full(6, m / 6)])
    deviation = everything - weight @ everything / weight.sum()
    scatter = sum(w * np.outer(x, x) for w, x in zip(weight, deviation, strict=True))
    prior = LocalPrior(torch.as_tensor(mu0)[None], torch.as_tensor(Phi)[None], m, n0)
    found = gmm.fit_joint(torch.as_tensor(points)[None], prior)
    np.testing.assert_allclose(found.covariance[0], scatter / (7 + n0), rtol=1e-12)


def test_conditioning_a_data_rich_joint_is_least_squares_with_an_intercept():
    rng = np.random.default_rng(9)
    x = rng.normal(size=(2, 200, 3)) * [1.0, 1e-2, 10.0] + [0.0, 5.0, -3.0]
    y = x @ rng.normal(size=(3, 2)) + [4.0, -1.0] + 0.1 * rng.normal(size=(2, 200, 2))
    points = np.concatenate([x, y], -1)
    none = LocalPrior(torch.zeros(2, 5).double(), torch.zeros(2, 5, 5).double(), m=0.0, n0=0.0)
    F, f, Sigma = gmm.condition_joint(gmm.fit_joint(torch.as_tensor(points), none), regressors=3)
    for t in range(2):
        augmented = np.concatenate([x[t], np.ones((200, 1))], 1)
        solution, *_ = np.linalg.lstsq(augmented, y[t], rcond=None)
        residual = y[t] - augmented @ solution
        # A ridge of 1e-6 variances on regressors with scales 1e3 apart biases slopes by 1e-3 at
        # most, and offsets by that times the means.
        np.testing.assert_allclose(F[t], solution[:3].T, atol=1e-3)
        np.testing.assert_allclose(f[t], solution[3], atol=5e-3)
        np.testing.assert_allclose(Sigma[t], residual.T @ residual / 200, rtol=1e-6)


def test_points_of_weight_zero_are_as_if_not_there():
    points = torch.as_tensor(clusters()[0].reshape(6, 100, 2)).clone()
    live = torch.arange(100) < torch.tensor([100, 40, 7, 2, 1, 60])[:, None]
    mixture = gmm.fit_mixture(points[live], 3, np.random.default_rng(7)).mixture
    points[~live] = 1e3
    prior = gmm.local_prior(mixture, points, live)
    joint = gmm.fit_joint(points, prior, live)
    for t in range(6):
        own = points[t : t + 1, live[t]]
        expected = gmm.local_prior(mixture, own)
        found = [part[t : t + 1] for part in (*prior[:2], *joint)]
        for left, right in zip(found, (*expected[:2], *gmm.fit_joint(own, expected)), strict=True):
            torch.testing.assert_close(left, right)
