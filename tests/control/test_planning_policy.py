"""A policy that plans: what it sees, what it carries, and its noise."""

import numpy as np
import torch
from test_latent_policy import Embedding, N, T, W, a, d, frames

from solar_cli.control.exploration import smooth_noise
from solar_cli.control.planning_policy import PlanningPolicy, latents_of
from solar_cli.episodes import window_indices
from solar_cli.settings import TaskSettings

H = 3


def task(window=W) -> TaskSettings:
    return TaskSettings.model_validate(
        {
            "simulator": "none",
            "horizon": T,
            "observation": {"kind": "state", "width": 4, "window": window},
            "action": {"size": a, "bound": 5.0},
            "exploration": {"std": 0.3},
        }
    )


class Planner:
    """Plans are sums of what is seen; all that it was asked is kept."""

    def __init__(self) -> None:
        self.asked: list[tuple[torch.Tensor, int, torch.Tensor | None]] = []

    def __call__(self, states, t, before):
        self.asked.append((states, t, before))
        first = states.sum(dim=1)[:, None, None] + torch.arange(a)
        return first + torch.arange(H)[:, None]


def run(policy: PlanningPolicy, seen: np.ndarray, stream=None) -> tuple[np.ndarray, np.ndarray]:
    index, state = window_indices(T, policy.task.observation.window), None
    state, actions, means = policy.start(len(seen), stream), [], []
    for t in range(T):
        action, mean, state = policy.act(seen[:, index[t]], t, state)
        actions.append(action)
        means.append(mean)
    return np.stack(actions, axis=1), np.stack(means, axis=1)


def test_it_takes_the_first_action_of_a_plan_for_the_window_it_sees():
    planner, embedding = Planner(), Embedding()
    actions, means = run(
        PlanningPolicy(latents_of(embedding, W), planner, 0.5, 0.0, task()), frames()
    )
    index = window_indices(T, W)
    for t, (states, at, _) in enumerate(planner.asked):
        windows = torch.from_numpy(frames()[:, index[t][::-1], :d])
        expected = embedding.basis.state(windows)
        torch.testing.assert_close(states, expected.float())
        assert at == t
        np.testing.assert_allclose(means[:, t, 0], expected.sum(dim=1), rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(actions, means)


def test_every_frame_is_encoded_once():
    embedding = Embedding()
    run(PlanningPolicy(latents_of(embedding, W), Planner(), 0.5, 0.0, task()), frames())
    np.testing.assert_array_equal(np.stack(embedding.encoded, axis=1), frames()[:, :T])


def test_a_plan_is_handed_to_the_next_step_and_an_episode_starts_without():
    planner = Planner()
    policy = PlanningPolicy(latents_of(Embedding(), W), planner, 0.5, 0.0, task())
    run(policy, frames())
    run(policy, frames())
    befores = [before for _, _, before in planner.asked]
    assert befores[0] is None
    assert befores[T] is None
    for t in range(1, T):
        states, _, _ = planner.asked[t - 1]
        assert befores[t].shape == (N, H, a)
        torch.testing.assert_close(befores[t][:, 0, 0], states.sum(dim=1))


def test_noise_is_smooth_has_its_deviation_and_is_not_in_the_means():
    policy = PlanningPolicy(latents_of(Embedding(), W), Planner(), 0.5, 1.5, task())
    noisy, means = run(policy, frames(), np.random.default_rng(5))
    quiet, _ = run(policy, frames())
    np.testing.assert_allclose(means, quiet)
    expected = 0.5 * smooth_noise((N, T, a), 1.5, np.random.default_rng(5))
    np.testing.assert_allclose(noisy - means, expected, atol=1e-12)
