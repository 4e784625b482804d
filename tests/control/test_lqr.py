"""LQR against quadratic programming and Riccati's equation; its KL bound against SLSQP."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lqr_problems import (
    Problem,
    dense_cost,
    dense_kl,
    dense_trajectory,
    random_problem,
)
from scipy import linalg, optimize

from solar_cli.control.linear_gaussian import (
    LinearDynamics,
    LinearGaussianPolicy,
    QuadraticCost,
    initial_policy,
    kl_divergence,
)
from solar_cli.control.lqr import TOLERANCE, Outcome, improve_policy, lqr_backward


def policies_close(a: LinearGaussianPolicy, b: LinearGaussianPolicy, tolerance: float) -> None:
    for left, right in zip(a, b, strict=True):
        torch.testing.assert_close(left, right, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("seed", range(3))
def test_feedback_plays_the_solution_of_the_trajectory_quadratic_programme(seed):
    T, d, a = 5, 3, 2
    _, dynamics, cost = random_problem(seed, T, d, a)
    F, f = dynamics.F.numpy(), dynamics.f.numpy()
    C, c, _ = (part.numpy() for part in cost)
    policy, definite = lqr_backward(dynamics, cost)
    z0 = np.random.default_rng(seed).normal(size=d)

    # x_t = G_t u + g_t for all actions u at once; then one linear system for u.
    H, h = np.zeros((T * a, T * a)), np.zeros(T * a)
    z_map, z = np.zeros((d, T * a)), z0
    for t in range(T + 1):
        action_map = np.eye(T * a)[t * a : (t + 1) * a] if t < T else np.zeros((a, T * a))
        G, g = np.concatenate([z_map, action_map]), np.concatenate([z, np.zeros(a)])
        H, h = H + G.T @ C[t] @ G, h + G.T @ (C[t] @ g + c[t])
        if t < T:
            z_map, z = F[t] @ G, F[t] @ g + f[t]
    best = -np.linalg.solve(H, h).reshape(T, a)

    z = z0
    for t in range(T):
        action = policy.K[t].numpy() @ z + policy.k[t].numpy()
        np.testing.assert_allclose(action, best[t], atol=1e-9)
        z = F[t] @ np.concatenate([z, action]) + f[t]
    assert definite


def test_long_horizon_gain_solves_the_discrete_riccati_equation():
    rng, T, d, a = np.random.default_rng(1), 200, 4, 2
    A, B = rng.normal(size=(d, d)) / 2, rng.normal(size=(d, a))
    root = rng.normal(size=(d + a, d + a))
    C = root @ root.T + 0.1 * np.eye(d + a)
    P = linalg.solve_discrete_are(A, B, C[:d, :d], C[d:, d:], s=C[:d, d:])
    Q_aa = C[d:, d:] + B.T @ P @ B
    gain = -np.linalg.solve(Q_aa, C[d:, :d] + B.T @ P @ A)

    eye = torch.eye(d, dtype=torch.float64)
    F = torch.as_tensor(np.concatenate([A, B], 1)).expand(T, d, d + a)
    dynamics = LinearDynamics(
        F, torch.zeros(T, d).double(), eye.expand(T, d, d), torch.zeros(d).double(), eye
    )
    stages = torch.as_tensor(C).expand(T + 1, d + a, d + a).clone()
    stages[-1] = 0
    zeros = torch.zeros(T + 1, d + a, dtype=torch.float64)
    policy, _ = lqr_backward(dynamics, QuadraticCost(stages, zeros, zeros[:, 0]))
    np.testing.assert_allclose(policy.K[0], gain, atol=1e-9)
    np.testing.assert_allclose(policy.S[0], np.linalg.inv(Q_aa), atol=1e-9)


def test_batched_costs_equal_a_loop_over_them():
    problems = [random_problem(seed) for seed in (2, 3)]
    dynamics = problems[0].dynamics
    costs = [problem.cost for problem in problems]
    indefinite = costs[0]._replace(C=-costs[0].C)
    together = QuadraticCost(
        *(torch.stack(parts) for parts in zip(*costs, indefinite, strict=True))
    )
    policies, definite = lqr_backward(dynamics, together)
    assert definite.tolist() == [True, True, False]
    for i in range(2):
        alone = LinearGaussianPolicy(*(part[i] for part in policies))
        policies_close(alone, lqr_backward(dynamics, costs[i]).policy, 1e-10)


def oracle_cost(problem: Problem, max_kl: float, std_bounds: tuple[float, float] | None) -> float:
    """Least expected cost under the bound, by SLSQP on the dense trajectory (d = a = 1)."""
    T = len(problem.policy.k)
    old = dense_trajectory(problem.policy, problem.dynamics)

    def trajectory(theta: np.ndarray):
        K, k, log_std = theta.reshape(3, T, 1)
        policy = LinearGaussianPolicy(
            *map(torch.as_tensor, (K[..., None], k, np.exp(2 * log_std)[..., None]))
        )
        return dense_trajectory(policy, problem.dynamics)

    def cost(theta: np.ndarray) -> float:
        return float(dense_cost(trajectory(theta), problem.cost, d=1, a=1).sum())

    start = np.stack(
        [problem.policy.K[:, 0, 0], problem.policy.k[:, 0], problem.policy.S[:, 0, 0].log() / 2]
    ).ravel()
    log_bounds = (None, None) if std_bounds is None else tuple(np.log(std_bounds))
    solution = optimize.minimize(
        cost,
        start,
        method="SLSQP",
        bounds=[(None, None)] * (2 * T) + [log_bounds] * T,
        constraints={"type": "ineq", "fun": lambda x: max_kl - dense_kl(trajectory(x), old)},
        options={"maxiter": 300, "ftol": 1e-12},
    )
    assert solution.success
    return float(solution.fun)


@pytest.mark.parametrize("action_cost", [0.0, 0.5])
@pytest.mark.parametrize("std_bounds", [None, (0.8, 1.0)])
@pytest.mark.parametrize("max_kl", [0.05, 2.0])
def test_constrained_update_is_as_good_as_a_general_optimiser_finds(
    action_cost, std_bounds, max_kl
):
    problem = random_problem(4, T=3, d=1, a=1, action_cost=action_cost)
    problem = problem._replace(
        policy=problem.policy._replace(S=torch.full_like(problem.policy.S, 0.9))
    )
    update = improve_policy(*problem, max_kl=max_kl, std_bounds=std_bounds)
    assert update.outcome is Outcome.CONVERGED
    # Compared at the KL that was really used. SLSQP's own accuracy sets the tolerance.
    best = oracle_cost(problem, update.kl, std_bounds)
    gain = update.predicted_before - update.predicted_after
    assert update.predicted_after == pytest.approx(best, abs=1e-4 * gain)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    log_scale=st.floats(-6, 6),
    log_kl=st.floats(-4, 3),
    action_cost=st.sampled_from([0.0, 1e-3, 1.0]),
    std_bounds=st.sampled_from([None, (0.05, 5.0)]),
)
def test_every_update_keeps_the_bound_and_predicts_no_harm(
    seed, log_scale, log_kl, action_cost, std_bounds
):
    scale, max_kl = 10**log_scale, 10**log_kl
    problem = random_problem(seed, T=6, d=3, a=2, action_cost=action_cost, scale=scale)
    update = improve_policy(*problem, max_kl=max_kl, std_bounds=std_bounds)
    dense = [dense_trajectory(p, problem.dynamics) for p in (update.policy, problem.policy)]
    assert update.outcome in (Outcome.CONVERGED, Outcome.UNCONSTRAINED)
    # The dense oracle inverts a covariance that a vanishing policy noise makes nearly singular.
    assert dense_kl(*dense) == pytest.approx(update.kl, rel=1e-3, abs=1e-6)
    assert update.kl <= max_kl
    if update.outcome is Outcome.CONVERGED:
        assert update.kl >= (1 - TOLERANCE) * max_kl
    assert update.predicted_after <= update.predicted_before + 1e-9 * scale
    assert float(dense_cost(dense[0], problem.cost, d=3, a=2).sum()) == pytest.approx(
        update.predicted_after, rel=1e-6, abs=1e-6 * scale
    )
    if std_bounds is not None:
        variances = torch.linalg.eigvalsh(update.policy.S)
        assert variances.min() >= std_bounds[0] ** 2 * (1 - 1e-9)
        assert variances.max() <= std_bounds[1] ** 2 * (1 + 1e-9)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_of_the_cost_change_nothing_but_eta(scale):
    plain = improve_policy(*random_problem(5), max_kl=1.0)
    scaled = improve_policy(*random_problem(5, scale=scale), max_kl=1.0)
    policies_close(scaled.policy, plain.policy, 1e-8)
    assert scaled.eta == pytest.approx(scale * plain.eta, rel=1e-9)


@pytest.mark.parametrize(
    ("A", "max_kl"),
    [
        (np.array([[2.0, 0.5, 0.0], [-1.0, 1.5, 0.3], [0.0, 0.7, -2.0]]), None),
        # The grid of eta depends on correlations but not on units: here it is the same grid.
        (np.diag([1e-3, 20.0, -1.0]), 1.0),
    ],
    ids=["mixing", "units"],
)
def test_an_affine_change_of_the_latents_changes_no_action(A, max_kl):
    policy, dynamics, cost = random_problem(6, T=4, d=3, a=2)
    A, b = torch.as_tensor(A), torch.tensor([0.3, -4.0, 1.0], dtype=torch.float64)
    inverse = torch.linalg.inv(A)
    # x = back x' + offset rewrites everything in the new latents z' = A z + b.
    back = torch.block_diag(inverse, torch.eye(2, dtype=torch.float64))
    offset = torch.cat([-inverse @ b, torch.zeros(2, dtype=torch.float64)])
    changed = Problem(
        LinearGaussianPolicy(policy.K @ inverse, policy.k - policy.K @ inverse @ b, policy.S),
        LinearDynamics(
            A @ dynamics.F @ back,
            (dynamics.F @ offset + dynamics.f) @ A.T + b,
            A @ dynamics.Sigma @ A.T,
            A @ dynamics.mu0 + b,
            A @ dynamics.Sigma0 @ A.T,
        ),
        QuadraticCost(
            back.T @ cost.C @ back,
            (cost.C @ offset + cost.c) @ back,
            cost.b + cost.c @ offset + (cost.C @ offset) @ offset / 2,
        ),
    )
    plain = improve_policy(policy, dynamics, cost, max_kl)
    other = improve_policy(*changed, max_kl)
    in_old_latents = LinearGaussianPolicy(
        other.policy.K @ A, other.policy.k + other.policy.K @ b, other.policy.S
    )
    policies_close(in_old_latents, plain.policy, 1e-8)
    assert other.kl == pytest.approx(plain.kl, rel=1e-8)
    assert other.predicted_after == pytest.approx(plain.predicted_after, rel=1e-8)


def test_a_tiny_eta_still_gives_the_cheapest_policy():
    problem = random_problem(8, T=10, action_cost=1e-3)
    update = improve_policy(*problem, max_kl=300.0)
    cheapest, _ = lqr_backward(problem.dynamics, problem.cost)
    assert update.eta < 1e-6
    torch.testing.assert_close(update.policy.K, cheapest.K, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(update.policy.k, cheapest.k, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("max_kl", [None, math.inf])
def test_without_a_bound_the_update_is_the_maximum_entropy_policy(max_kl):
    problem = random_problem(9)
    update = improve_policy(*problem, max_kl=max_kl)
    policies_close(update.policy, lqr_backward(problem.dynamics, problem.cost).policy, 0.0)
    assert update.outcome is Outcome.UNCONSTRAINED
    assert update.kl == pytest.approx(
        float(kl_divergence(update.policy, problem.policy, problem.dynamics).sum())
    )


def test_no_cost_means_no_change():
    policy, dynamics, cost = random_problem(10)
    update = improve_policy(policy, dynamics, QuadraticCost(*(0 * part for part in cost)), 1.0)
    policies_close(update.policy, policy, 1e-10)
    assert (update.outcome, update.kl) == (Outcome.UNCONSTRAINED, pytest.approx(0, abs=1e-9))


def test_an_indefinite_cost_limits_the_step_and_is_said():
    policy, dynamics, cost = random_problem(11)
    update = improve_policy(policy, dynamics, cost._replace(C=-cost.C), max_kl=1e3)
    assert update.outcome is Outcome.CURVATURE_LIMITED
    assert 0 < update.kl < 1e3
    assert update.predicted_after < update.predicted_before
    assert torch.all(torch.linalg.eigvalsh(update.policy.S) > 0)


@pytest.mark.parametrize(
    ("max_kl", "change", "outcome"),
    [
        (1.0, lambda C: C * math.nan, Outcome.NOT_POSITIVE_DEFINITE),
        (None, lambda C: -C, Outcome.NOT_POSITIVE_DEFINITE),
        (0.0, lambda C: C, Outcome.BRACKET_EXHAUSTED),
    ],
)
@pytest.mark.parametrize("std_bounds", [None, (1e-3, 1e3)])
def test_when_no_step_is_possible_the_previous_policy_comes_back(
    max_kl, change, outcome, std_bounds
):
    policy, dynamics, cost = random_problem(12, a=3)
    cost = cost._replace(C=change(cost.C))
    update = improve_policy(policy, dynamics, cost, max_kl, std_bounds)
    assert update.outcome is outcome
    # Within bounds the covariance goes through its eigenvalues.
    policies_close(update.policy, policy, 0.0 if std_bounds is None else 1e-12)


@pytest.mark.parametrize(("growth", "max_kl"), [(1.5, 10.0), (3.0, 10.0), (3.0, 0.1)])
def test_exploding_model_dynamics_are_no_obstacle(growth, max_kl):
    """At growth 3 the states' variance reaches 1e30 under the previous policy."""
    policy, dynamics, cost = random_problem(13, T=60)
    update = improve_policy(policy, dynamics._replace(F=growth * dynamics.F), cost, max_kl)
    assert update.outcome is Outcome.CONVERGED
    assert update.kl <= max_kl
    assert update.predicted_after < update.predicted_before


def test_the_noise_floor_costs_no_divergence():
    """A floor at the old noise leaves the whole bound for the means: a better policy."""
    policy = initial_policy(10, 2, 2, std=0.3)
    _, dynamics, cost = random_problem(14, T=10)
    floor = (0.3, 1.0)
    inside = improve_policy(policy, dynamics, cost, max_kl=5.0, std_bounds=floor)
    noise_only = policy._replace(S=inside.policy.S)
    assert float(kl_divergence(noise_only, policy, dynamics).sum()) == pytest.approx(0, abs=1e-9)
    free = improve_policy(policy, dynamics, cost, max_kl=5.0)
    shifted = policy._replace(S=free.policy.S)
    assert float(kl_divergence(shifted, policy, dynamics).sum()) > 0.1
