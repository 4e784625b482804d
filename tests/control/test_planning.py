"""Planning by samples against closed forms, brute force and a loop over episodes."""

import numpy as np
import pytest
import torch

from solar_cli.control import planning
from solar_cli.control.planning import (
    RolledOut,
    Search,
    cross_entropy,
    random_shooting,
    shifted,
)

N, S, H, z, a = 3, 40, 4, 3, 2
A = np.random.default_rng(0).normal(0, 0.4, (z, z)) + 0.6 * np.eye(z)
B = np.random.default_rng(1).normal(size=(z, a))
ALPHA = 0.1


def dynamics(states, actions):
    return states @ torch.tensor(A.T).to(states) + actions @ torch.tensor(B.T).to(states)


def cost(states, actions):
    return states.square().sum(dim=-1) + ALPHA * actions.square().sum(dim=-1)


def starts(count=N) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(2).normal(size=(count, z)))


def sequences(count=S, seed=3, bound=1.0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-bound, bound, (count, H, a)))


def by_hand(start: np.ndarray, actions: np.ndarray) -> float:
    """The cost of one sequence from one start."""
    total, state = 0.0, start
    for action in actions:
        state = A @ state + B @ action
        total += state @ state + ALPHA * action @ action
    return total


def normal(seed=4, samples=400):
    def draw(iteration: int) -> torch.Tensor:
        stream = np.random.default_rng((seed, iteration))
        return torch.from_numpy(stream.standard_normal((samples, H, a)))

    return draw


def optimum(start: np.ndarray) -> np.ndarray:
    """(H, a) of least cost: a sequence's states are linear in it, so least squares says it."""
    reach = np.zeros((H * z, H * a))
    free = np.zeros(H * z)
    for i in range(H):
        rows = slice(i * z, (i + 1) * z)
        free[rows] = np.linalg.matrix_power(A, i + 1) @ start
        for j in range(i + 1):
            reach[rows, j * a : (j + 1) * a] = np.linalg.matrix_power(A, i - j) @ B
    design = np.concatenate([reach, np.sqrt(ALPHA) * np.eye(H * a)])
    target = np.concatenate([-free, np.zeros(H * a)])
    return np.linalg.lstsq(design, target, rcond=None)[0].reshape(H, a)


@pytest.mark.parametrize("rows", [1, S, 2 * S, 10**6])
def test_a_forecast_is_the_sum_of_costs_along_each_sequence(monkeypatch, rows):
    """However many are predicted at a time."""
    monkeypatch.setattr(planning, "ROWS", rows)
    actions = torch.stack([sequences(seed=i) for i in range(N)])
    found = RolledOut(dynamics, cost, starts())(actions)
    expected = [[by_hand(s, u) for u in us] for s, us in zip(starts().numpy(), actions.numpy(), strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_prediction_that_is_no_number_is_never_chosen():
    def breaking(states, actions):
        following = dynamics(states, actions)
        return torch.where(actions[:, :1] > 0, torch.nan, following)

    forecast = RolledOut(breaking, cost, starts())
    actions = sequences()
    actions[: S // 2, 0, 0] = 0.5
    actions[S // 2 :, :, 0] = -0.5
    assert (random_shooting(forecast, N, actions)[..., 0] == -0.5).all()


def test_random_shooting_takes_the_best_sequence_of_each_episode():
    actions = sequences()
    found = random_shooting(RolledOut(dynamics, cost, starts()), N, actions)
    for start, plan in zip(starts().numpy(), found.numpy(), strict=True):
        costs = [by_hand(start, u) for u in actions.numpy()]
        np.testing.assert_array_equal(plan, actions[int(np.argmin(costs))])


def test_cross_entropy_finds_the_plan_of_a_linear_quadratic_problem():
    search = Search(iterations=40, elites=40, bound=100.0, std=2.0, least_std=1e-4)
    forecast = RolledOut(dynamics, cost, starts())
    found = cross_entropy(forecast, torch.zeros(N, H, a).double(), search, normal())
    for start, plan in zip(starts().numpy(), found.numpy(), strict=True):
        np.testing.assert_allclose(plan, optimum(start), atol=0.01)


def test_cross_entropy_stays_within_the_bound_and_reaches_it():
    """The last step's unbounded optimum is beyond it: along one axis costs only fall."""

    def downhill(states, actions):
        return -actions[:, 0] + actions[:, 1].square()

    tried = []

    def forecast(actions):
        tried.append(actions.abs().max())
        return RolledOut(dynamics, downhill, starts())(actions)

    search = Search(iterations=20, elites=20, bound=0.7, std=0.5, least_std=1e-3)
    found = cross_entropy(forecast, torch.zeros(N, H, a).double(), search, normal())
    assert max(tried) <= 0.7
    np.testing.assert_allclose(found[..., 0], 0.7, atol=2e-3)
    np.testing.assert_allclose(found[..., 1], 0.0, atol=2e-2)


def test_cross_entropy_tries_the_plan_that_it_starts_from():
    """With draws that are far worse, the elites are that plan alone."""
    best = torch.stack([torch.from_numpy(optimum(s)) for s in starts().numpy()])
    search = Search(iterations=1, elites=1, bound=1e6, std=1e3, least_std=0.0)
    found = cross_entropy(RolledOut(dynamics, cost, starts()), best, search, normal())
    torch.testing.assert_close(found, best, rtol=0, atol=0)


@pytest.mark.parametrize("method", ["cross_entropy", "random_shooting"])
def test_a_plan_does_not_depend_on_the_episodes_beside_it(method):
    def plan(start: torch.Tensor) -> torch.Tensor:
        forecast = RolledOut(dynamics, cost, start)
        if method == "random_shooting":
            return random_shooting(forecast, len(start), sequences())
        search = Search(iterations=3, elites=10, bound=1.0, std=0.5, least_std=1e-3)
        return cross_entropy(forecast, torch.zeros(len(start), H, a).double(), search, normal())

    together = plan(starts())
    for i in range(N):
        torch.testing.assert_close(plan(starts()[i : i + 1])[0], together[i])


def test_a_plan_one_step_later_has_a_new_end():
    plan = torch.arange(12.0).view(1, 6, 2)
    last = torch.tensor([-1.0, -2.0])
    expected = [[2, 3], [4, 5], [6, 7], [8, 9], [10, 11], [-1, -2]]
    np.testing.assert_array_equal(shifted(plan, last)[0], expected)
