"""Time-varying linear-Gaussian policies and dynamics, quadratic costs, and what they imply.

    z_0 ~ N(mu0, Sigma0),   a_t ~ N(K_t z_t + k_t, S_t),   z_{t+1} ~ N(F_t x_t + f_t, Sigma_t)
    cost_t = 1/2 x_t^T C_t x_t + c_t^T x_t + b_t            with x_t = [z_t; a_t]

Trajectories are jointly Gaussian, so means, expected costs and divergences are exact.

Axes: T horizon, d latent, a action, p = d + a. Leading axes of a policy are batch axes; dynamics
and costs broadcast against them. float64.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from solar_cli.inference import cholesky


class LinearGaussianPolicy(NamedTuple):
    """a_t ~ N(K_t z_t + k_t, S_t); S is a covariance."""

    K: Float[Tensor, "*batch T a d"]
    k: Float[Tensor, "*batch T a"]
    S: Float[Tensor, "*batch T a a"]

    def until(self, steps: int) -> LinearGaussianPolicy:
        """Of the first time steps; without batch axes."""
        return LinearGaussianPolicy(*(part[:steps] for part in self))

    def held(self, steps: int, horizon: int) -> LinearGaussianPolicy:
        """Of the first time steps, the last of which goes on until T = ``horizon``; no batch."""
        times = torch.arange(horizon).clamp(max=steps - 1)
        return LinearGaussianPolicy(*(part[times] for part in self))


class LinearDynamics(NamedTuple):
    """z_{t+1} ~ N(F_t x_t + f_t, Sigma_t) from z_0 ~ N(mu0, Sigma0)."""

    F: Float[Tensor, "T d p"]
    f: Float[Tensor, "T d"]
    Sigma: Float[Tensor, "T d d"]
    mu0: Float[Tensor, " d"]
    Sigma0: Float[Tensor, "d d"]


class QuadraticCost(NamedTuple):
    """Cost of t = 0..T; no action is taken at T, so the action part of the last entry is unused."""

    C: Float[Tensor, "T+1 p p"]
    c: Float[Tensor, "T+1 p"]
    b: Float[Tensor, " T+1"]


class Marginals(NamedTuple):
    """Gaussian of x_t = [z_t; a_t] for t = 0..T; the action part of the last entry is zero."""

    mean: Float[Tensor, "*batch T+1 p"]
    covariance: Float[Tensor, "*batch T+1 p p"]


def initial_policy(horizon: int, d: int, a: int, std: float) -> LinearGaussianPolicy:
    """White noise of that standard deviation around zero, whatever the state."""
    S = std**2 * torch.eye(a, dtype=torch.float64).expand(horizon, a, a)
    return LinearGaussianPolicy(
        K=torch.zeros(horizon, a, d, dtype=torch.float64),
        k=torch.zeros(horizon, a, dtype=torch.float64),
        S=S.clone(),
    )


def bounded(policy: LinearGaussianPolicy, floor: float, ceiling: float) -> LinearGaussianPolicy:
    """The policy with every principal standard deviation of its noise within [floor, ceiling]."""
    values, vectors = torch.linalg.eigh(policy.S)
    values = values.clamp(floor**2, ceiling**2)
    return policy._replace(S=(vectors * values[..., None, :]) @ vectors.mT)


def state_marginals(
    policy: LinearGaussianPolicy, dynamics: LinearDynamics
) -> tuple[Float[Tensor, "*batch T+1 d"], Float[Tensor, "*batch T+1 d d"]]:
    """Means and covariances of z_0..z_T under the policy."""
    d = dynamics.mu0.shape[-1]
    F_z, F_a = dynamics.F[..., :d], dynamics.F[..., d:]
    closed_loop = F_z + F_a @ policy.K
    drift = dynamics.f + (F_a @ policy.k[..., None])[..., 0]
    noise = F_a @ policy.S @ F_a.mT + dynamics.Sigma
    mean = dynamics.mu0.expand(*drift.shape[:-2], d)
    covariance = dynamics.Sigma0.expand(*drift.shape[:-2], d, d)
    means, covariances = [mean], [covariance]
    for A, f, Q in zip(closed_loop.unbind(-3), drift.unbind(-2), noise.unbind(-3), strict=True):
        mean = (A @ mean[..., None])[..., 0] + f
        covariance = A @ covariance @ A.mT + Q
        means.append(mean)
        covariances.append(covariance)
    return torch.stack(means, -2), torch.stack(covariances, -3)


def marginals(policy: LinearGaussianPolicy, dynamics: LinearDynamics) -> Marginals:
    """Means and covariances of x_0..x_T under the policy."""
    z_mean, z_covariance = state_marginals(policy, dynamics)
    T = policy.k.shape[-2]
    K_z = policy.K @ z_covariance[..., :T, :, :]
    a_mean = (policy.K @ z_mean[..., :T, :, None])[..., 0] + policy.k
    a_covariance = K_z @ policy.K.mT + policy.S
    pad = torch.nn.functional.pad
    mean = torch.cat([z_mean, pad(a_mean, (0, 0, 0, 1))], -1)
    cross = pad(K_z, (0, 0, 0, 0, 0, 1))
    lower = torch.cat([cross, pad(a_covariance, (0, 0, 0, 0, 0, 1))], -1)
    covariance = torch.cat([torch.cat([z_covariance, cross.mT], -1), lower], -2)
    return Marginals(mean, covariance)


def expected_cost(
    policy: LinearGaussianPolicy, dynamics: LinearDynamics, cost: QuadraticCost
) -> Float[Tensor, "*batch T+1"]:
    """Expected cost of each time step under the policy."""
    mean, covariance = marginals(policy, dynamics)
    gradient = 0.5 * (cost.C @ mean[..., None])[..., 0] + cost.c
    return 0.5 * (cost.C * covariance).sum((-2, -1)) + (gradient * mean).sum(-1) + cost.b


def kl_divergence(
    new: LinearGaussianPolicy, old: LinearGaussianPolicy, dynamics: LinearDynamics
) -> Float[Tensor, "*batch T"]:
    """KL(new || old) of each time step's action in nats, expected over the new policy's states.

    Both policies meet the same dynamics, so the sum over time is the divergence of the two
    distributions over trajectories (section 4.2, Appendix C).
    """
    T, a = new.k.shape[-2:]
    z_mean, z_covariance = state_marginals(new, dynamics)
    z_mean, z_covariance = z_mean[..., :T, :], z_covariance[..., :T, :, :]
    factor = torch.linalg.cholesky(old.S)
    precision = torch.cholesky_inverse(factor)
    gain = new.K - old.K
    shift = (gain @ z_mean[..., None])[..., 0] + new.k - old.k
    second_moment = gain @ z_covariance @ gain.mT + shift[..., None] * shift[..., None, :] + new.S
    log_ratio = cholesky.log_determinant(factor) - torch.logdet(new.S)
    divergence = ((precision * second_moment).sum((-2, -1)) - a + log_ratio) / 2
    return divergence.clamp(min=0)  # rounding makes the divergence of equal policies negative
