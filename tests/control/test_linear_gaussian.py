"""Marginals, costs and divergences of trajectories against one dense Gaussian and simulation."""

from __future__ import annotations

import numpy as np
import torch
from lqr_problems import dense_cost, dense_kl, dense_trajectory, random_problem

from solar_cli.control.linear_gaussian import (
    LinearGaussianPolicy,
    bounded,
    expected_cost,
    initial_policy,
    kl_divergence,
    marginals,
)


def test_marginals_are_blocks_of_the_dense_trajectory():
    policy, dynamics, _ = random_problem(1, T=5, d=3, a=2)
    dense = dense_trajectory(policy, dynamics)
    mean, covariance = marginals(policy, dynamics)
    for t in range(6):
        size = 5 if t < 5 else 3
        block = slice(5 * t, 5 * t + size)
        np.testing.assert_allclose(mean[t, :size], dense.mean[block], atol=1e-10)
        np.testing.assert_allclose(
            covariance[t, :size, :size], dense.covariance[block, block], atol=1e-10
        )
    assert torch.all(covariance[5, 3:] == 0)
    assert torch.all(mean[5, 3:] == 0)


def test_expected_cost_is_that_of_the_dense_trajectory():
    policy, dynamics, cost = random_problem(2)
    dense = dense_cost(dense_trajectory(policy, dynamics), cost, d=2, a=2)
    np.testing.assert_allclose(expected_cost(policy, dynamics, cost), dense, atol=1e-10)


def test_divergence_is_that_of_the_dense_trajectories():
    (new, dynamics, _), (old, _, _) = random_problem(3), random_problem(4)
    dense = dense_kl(dense_trajectory(new, dynamics), dense_trajectory(old, dynamics))
    value = float(kl_divergence(new, old, dynamics).sum())
    np.testing.assert_allclose(value, dense, rtol=1e-9)
    assert torch.all(kl_divergence(new, new, dynamics) < 1e-12)


def test_divergence_is_the_mean_log_ratio_over_simulated_trajectories():
    (new, dynamics, _), (old, _, _) = random_problem(5), random_problem(6)
    rng, n = np.random.default_rng(7), 40_000
    F, f, Sigma, mu0, Sigma0 = (part.numpy() for part in dynamics)

    def normal(covariance: np.ndarray) -> np.ndarray:
        return rng.normal(size=(n, len(covariance))) @ np.linalg.cholesky(covariance).T

    def log_density(policy: LinearGaussianPolicy, t: int, z: np.ndarray, a: np.ndarray):
        K, k, S = (part[t].numpy() for part in policy)
        error = a - z @ K.T - k
        square = (error @ np.linalg.inv(S) * error).sum(1)
        return -0.5 * (square + np.linalg.slogdet(S)[1])

    z = mu0 + normal(Sigma0)
    for t, expected in enumerate(kl_divergence(new, old, dynamics)):
        K, k, S = (part[t].numpy() for part in new)
        a = z @ K.T + k + normal(S)
        ratio = log_density(new, t, z, a) - log_density(old, t, z, a)
        # Five standard errors.
        assert abs(ratio.mean() - float(expected)) < 5 * ratio.std() / np.sqrt(n)
        z = np.concatenate([z, a], 1) @ F[t].T + f[t] + normal(Sigma[t])


def test_batched_policies_equal_a_loop_over_them():
    problems = [random_problem(seed) for seed in (8, 9, 10)]
    _, dynamics, cost = problems[0]
    together = LinearGaussianPolicy(
        *(torch.stack(parts) for parts in zip(*(p.policy for p in problems), strict=True))
    )
    costs = expected_cost(together, dynamics, cost)
    divergences = kl_divergence(together, problems[0].policy, dynamics)
    for i, (policy, _, _) in enumerate(problems):
        torch.testing.assert_close(costs[i], expected_cost(policy, dynamics, cost))
        alone = kl_divergence(policy, problems[0].policy, dynamics)
        torch.testing.assert_close(divergences[i], alone)


def test_bounds_clip_principal_deviations_and_keep_their_axes():
    rng = np.random.default_rng(11)
    axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    policy = initial_policy(2, 4, 3, std=1.0)
    S = torch.as_tensor(axes @ np.diag([0.01, 0.25, 9.0]) @ axes.T).expand(2, 3, 3)
    clipped = bounded(policy._replace(S=S), floor=0.2, ceiling=2.0)
    expected = axes @ np.diag([0.04, 0.25, 4.0]) @ axes.T
    np.testing.assert_allclose(clipped.S, np.stack([expected] * 2), atol=1e-12)


def test_initial_policy_is_white_noise_around_zero():
    policy = initial_policy(3, 4, 2, std=0.5)
    assert [tuple(part.shape) for part in policy] == [(3, 2, 4), (3, 2), (3, 2, 2)]
    assert not policy.K.any()
    assert not policy.k.any()
    assert torch.equal(policy.S[1], 0.25 * torch.eye(2, dtype=torch.float64))
