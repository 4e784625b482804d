"""Small linear-quadratic problems, and their trajectories as one dense Gaussian (NumPy only)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from solar_cli.control.linear_gaussian import LinearDynamics, LinearGaussianPolicy, QuadraticCost


class Problem(NamedTuple):
    policy: LinearGaussianPolicy
    dynamics: LinearDynamics
    cost: QuadraticCost


def definite(rng: np.random.Generator, *shape: int, size: int) -> np.ndarray:
    root = rng.normal(size=(*shape, size, size + 1))
    return root @ root.swapaxes(-1, -2) / size + 0.1 * np.eye(size)


def random_problem(
    seed: int, T: int = 4, d: int = 2, a: int = 2, action_cost: float = 0.5, scale: float = 1.0
) -> Problem:
    """Affine dynamics, a full cost with cross terms (none on actions alone when it is 0)."""
    rng = np.random.default_rng(seed)
    p = d + a
    F = rng.normal(size=(T, d, p)) / np.sqrt(p)
    dynamics = (F, rng.normal(size=(T, d)), 0.1 * definite(rng, T, size=d))
    initial = (rng.normal(size=d), definite(rng, size=d))
    C, c = definite(rng, T + 1, size=p), rng.normal(size=(T + 1, p))
    C[:, d:, d:] = C[:, d:, d:] + action_cost * np.eye(a)
    if action_cost == 0:
        C[:, d:], C[:, :, d:], c[:, d:] = 0, 0, 0
    C[-1, d:], C[-1, :, d:], c[-1, d:] = 0, 0, 0
    policy = (0.3 * rng.normal(size=(T, a, d)), rng.normal(size=(T, a)), definite(rng, T, size=a))
    tensors = [torch.as_tensor(part) for part in (*policy, *dynamics, *initial)]
    costs = [torch.as_tensor(scale * part) for part in (C, c, rng.normal(size=T + 1))]
    return Problem(
        LinearGaussianPolicy(*tensors[:3]), LinearDynamics(*tensors[3:]), QuadraticCost(*costs)
    )


class DenseTrajectory(NamedTuple):
    """Mean and covariance of (z_0, a_0, z_1, a_1, ..., z_T), one vector."""

    mean: np.ndarray
    covariance: np.ndarray


def dense_trajectory(policy: LinearGaussianPolicy, dynamics: LinearDynamics) -> DenseTrajectory:
    """Every variable as an affine map of independent unit noise: no recursion of covariances."""
    K, k, S = (part.numpy() for part in policy)
    F, f, Sigma, mu0, Sigma0 = (part.numpy() for part in dynamics)
    T, a, d = K.shape
    size = d + T * (a + d)
    noise = np.eye(size)

    def draw(start: int, root: np.ndarray) -> np.ndarray:
        return root @ noise[start : start + len(root)]

    z, z_map = mu0, draw(0, np.linalg.cholesky(Sigma0))
    means, maps = [z], [z_map]
    for t in range(T):
        start = d + t * (a + d)
        action = K[t] @ z + k[t]
        action_map = K[t] @ z_map + draw(start, np.linalg.cholesky(S[t]))
        z = F[t] @ np.concatenate([z, action]) + f[t]
        z_map = F[t] @ np.concatenate([z_map, action_map])
        z_map = z_map + draw(start + a, np.linalg.cholesky(Sigma[t]))
        means += [action, z]
        maps += [action_map, z_map]
    joint = np.concatenate(maps)
    return DenseTrajectory(np.concatenate(means), joint @ joint.T)


def dense_cost(trajectory: DenseTrajectory, cost: QuadraticCost, d: int, a: int) -> np.ndarray:
    """Expected cost of each time step from the dense Gaussian's blocks."""
    C, c, b = (part.numpy() for part in cost)
    values = []
    for t in range(len(b)):
        size = d + a if t < len(b) - 1 else d
        block = slice(t * (d + a), t * (d + a) + size)
        mean, covariance = trajectory.mean[block], trajectory.covariance[block, block]
        second = covariance + np.outer(mean, mean)
        linear = c[t, :size] @ mean + b[t]
        values.append(0.5 * np.sum(C[t, :size, :size] * second) + linear)
    return np.array(values)


def dense_kl(new: DenseTrajectory, old: DenseTrajectory) -> float:
    """KL of two dense Gaussians."""
    precision = np.linalg.inv(old.covariance)
    shift = new.mean - old.mean
    log_ratio = np.linalg.slogdet(old.covariance)[1] - np.linalg.slogdet(new.covariance)[1]
    trace = np.trace(precision @ new.covariance)
    return 0.5 * float(trace + shift @ precision @ shift - len(shift) + log_ratio)
