"""LINEARIZEPOLICY: exact under an affine change of the latents, honest about anything else."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from solar_cli.control.linear_gaussian import LinearGaussianPolicy, initial_policy
from solar_cli.control.linearise import RIDGES, linearise_policy

N, T, d, a = 12, 5, 4, 2


def acting_policy(seed: int) -> LinearGaussianPolicy:
    rng = np.random.default_rng(seed)
    S = np.tile(np.diag([0.3, 0.7]), (T, 1, 1))
    return LinearGaussianPolicy(
        *map(torch.as_tensor, (rng.normal(size=(T, a, d)), rng.normal(size=(T, a)), S))
    )


def latents(seed: int, episodes: int = N) -> torch.Tensor:
    """Latents of very different means and spreads."""
    rng = np.random.default_rng(seed)
    white = rng.normal(size=(episodes, T, d))
    return torch.as_tensor(white * [1.0, 0.05, 3.0, 0.3] + [0.0, 1.0, -20.0, 5.0])


def means(policy: LinearGaussianPolicy, z: torch.Tensor) -> torch.Tensor:
    return torch.einsum("tad,ntd->nta", policy.K, z) + policy.k


def linearise(z, actions, policy):
    """Episodes of which none ended early."""
    return linearise_policy(z, actions, torch.ones(z.shape[:2], dtype=torch.bool), policy)


def test_an_affine_change_of_the_latents_is_recovered_exactly():
    policy, z = acting_policy(1), latents(2)
    rng = np.random.default_rng(3)
    A = torch.as_tensor(rng.normal(size=(d, d)) + 2 * np.eye(d))
    b = torch.as_tensor(rng.normal(size=d))
    fit = linearise(z @ A.T + b, means(policy, z), policy)
    expected = policy.K @ torch.linalg.inv(A)
    # The least ridge, 1e-10 variances, times the condition number of the new latents (1e4).
    torch.testing.assert_close(fit.policy.K, expected, rtol=1e-5, atol=1e-5)
    fresh = latents(4)
    torch.testing.assert_close(
        means(fit.policy, fresh @ A.T + b), means(policy, fresh), rtol=0, atol=1e-4
    )
    torch.testing.assert_close(fit.policy.S, policy.S, rtol=1e-8, atol=1e-8)
    assert fit.residual < 1e-5
    assert fit.ridge == RIDGES[0]


def test_left_out_errors_are_those_of_refitting_without_each_episode():
    policy, z = acting_policy(5), latents(6)
    actions = means(policy, z) + torch.as_tensor(np.random.default_rng(7).normal(size=(N, T, a)))
    fit = linearise(z, actions, policy)
    total, spread = 0.0, 0.0
    extra = np.zeros((T, a, a))
    for t in range(T):
        x, y = z[:, t].numpy(), actions[:, t].numpy()
        penalty = np.diag([*(N * fit.ridge * x.var(0)), 0.0])
        augmented = np.concatenate([x, np.ones((N, 1))], 1)
        for i in range(N):
            kept = np.arange(N) != i
            X, Y = augmented[kept], y[kept]
            coefficients = np.linalg.solve(X.T @ X + penalty, X.T @ Y)
            error = y[i] - augmented[i] @ coefficients
            total += error @ error
            extra[t] += np.outer(error, error) / N
        spread += ((y - y.mean(0)) ** 2).sum()
    assert fit.residual == pytest.approx(np.sqrt(total / spread), rel=1e-6)
    np.testing.assert_allclose(fit.policy.S, policy.S.numpy() + extra, rtol=1e-6)


def test_unexplained_means_become_noise_of_the_policy():
    policy, z = acting_policy(8), latents(9, episodes=400)
    wobble = 0.5 * torch.as_tensor(np.random.default_rng(10).normal(size=(400, T, a)))
    fit = linearise(z, means(policy, z) + wobble, policy)
    added = (fit.policy.S - policy.S).diagonal(dim1=-2, dim2=-1)
    # A variance from 400 samples has a standard error of 7 %.
    np.testing.assert_allclose(added, 0.25, rtol=0.35)
    torch.testing.assert_close(fit.policy.K[..., 0], policy.K[..., 0], rtol=0.2, atol=0.15)


def test_noise_free_means_do_not_depend_on_a_constant_latent():
    policy, z = acting_policy(11), latents(12)
    z[..., 3] = 7.0
    fit = linearise(z, means(policy, z), policy)
    assert torch.all(fit.policy.K[..., 3].abs() < 1e-8)
    torch.testing.assert_close(means(fit.policy, z), means(policy, z), rtol=1e-6, atol=1e-6)


def test_white_noise_stays_white_noise():
    policy, z = initial_policy(T, d, a, std=0.4), latents(13)
    fit = linearise(z, means(policy, z), policy)
    assert not fit.policy.K.any()
    assert torch.equal(fit.policy.S, policy.S)
    assert fit.residual == 0.0


def test_fewer_episodes_than_latents_still_reproduce_the_means_and_admit_doubt():
    policy, z = acting_policy(14), latents(15, episodes=3)
    fit = linearise(z, means(policy, z), policy)
    assert all(torch.isfinite(part).all() for part in fit.policy)
    assert fit.residual > 0.1
    assert torch.all(torch.linalg.eigvalsh(fit.policy.S - policy.S) > -1e-9)


def test_one_episode_is_an_error():
    policy, z = acting_policy(16), latents(17, episodes=1)
    with pytest.raises(ValueError, match="at least 2 episodes, got 1"):
        linearise(z, means(policy, z), policy)
