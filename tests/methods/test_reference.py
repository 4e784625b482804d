"""Reference policies: what they do, with noise or without."""

import numpy as np
import pytest
from method_runs import Run

from solar_cli.envs import build_task
from solar_cli.episodes import evaluate
from solar_cli.experience import Experience
from solar_cli.streams import Streams


def judged(run: Run, episodes: int, seed: int = 0) -> np.ndarray:
    task = run.configuration.task
    found = evaluate(build_task(task), task, run.learner.policy, episodes, Streams(seed))
    return found.episodes.actions


def collected(run: Run) -> np.ndarray:
    experience = Experience(run.iterate(1, 1).environment)
    return np.concatenate([experience.batch(name).actions for name in experience.batches()])


def test_zero_does_nothing(tmp_path):
    run = Run(tmp_path, "zero")
    assert not judged(run, 3).any()
    actions = collected(run)
    assert len(actions) == run.configuration.method.episodes
    assert not actions.any()


@pytest.mark.parametrize("noisy", [True, False])
def test_random_is_uniform_between_the_bounds(tmp_path, noisy):
    """Moments of 1000 actions of two entries; a mean's std is .013, a square's .007."""
    run = Run(tmp_path, "random", "episodes=167")
    actions = collected(run) if noisy else judged(run, 167)
    bound = run.configuration.task.action.bound
    assert np.abs(actions).max() <= bound
    assert np.abs(actions).max() > 0.99 * bound
    np.testing.assert_allclose(actions.mean() / bound, 0.0, atol=0.05)
    np.testing.assert_allclose(np.square(actions / bound).mean(), 1 / 3, atol=0.03)


def test_random_does_not_repeat_itself(tmp_path):
    """Neither in groups of episodes that run one after another, nor collected and judged."""
    run = Run(tmp_path, "random")
    policy = run.learner.policy
    groups = [policy.start(3, None) for _ in range(2)]
    assert not np.isin(groups[0], groups[1]).any()
    assert not np.isin(collected(run), judged(run, 5)).any()


def test_groups_of_episodes_do_what_all_at_once_do(tmp_path):
    policy = Run(tmp_path, "random").learner.policy
    again = Run(tmp_path, "random").learner.policy
    groups = np.concatenate([policy.start(2, None), policy.start(3, None)])
    np.testing.assert_array_equal(groups, again.start(5, None))
