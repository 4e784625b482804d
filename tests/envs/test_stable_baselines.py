"""Our vector environment for Stable-Baselines3 equals its own loop over our singles."""

import gymnasium
import numpy as np
import pytest
from drawing import skip_if_it_cannot_be_drawn
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from solar_cli.envs.front_ends import IDS, SingleEnv, task_settings
from solar_cli.envs.stable_baselines import BatchedVecEnv

ROWS = 3


@pytest.fixture(params=["Solar/Navigation-v0", "Solar/CarStates-v0", "Solar/Car-v0"])
def both(request):
    skip_if_it_cannot_be_drawn(task_settings(IDS[request.param]))
    make = lambda: gymnasium.make(request.param, render_mode="rgb_array")  # noqa: E731
    return BatchedVecEnv(IDS[request.param], ROWS), DummyVecEnv([make] * ROWS)


def same(one, two):
    """Equal in type, keys and every bit."""
    assert type(one) is type(two)
    if isinstance(one, dict):
        assert one.keys() == two.keys()
        for key in one:
            same(one[key], two[key])
    elif isinstance(one, list | tuple):
        for left, right in zip(one, two, strict=True):
            same(left, right)
    elif isinstance(one, np.ndarray):
        assert one.dtype == two.dtype
        assert np.array_equal(one, two)
    else:
        assert one == two


def test_it_equals_a_loop_over_singles(both):
    ours, loop = both
    horizon = ours.batched._core.settings.horizon
    assert ours.observation_space == loop.observation_space
    assert ours.action_space == loop.action_space
    for env in both:
        env.seed(5)
    same(ours.reset(), loop.reset())
    same(ours.reset_infos, loop.reset_infos)
    bound = 1.3 * ours.action_space.high[0]
    draws, ends = np.random.default_rng(0), 0
    for _ in range(2 * horizon + 3):
        actions = draws.uniform(-bound, bound, (ROWS, 2)).astype(np.float32)
        shown = ours.step(actions)
        same(shown, loop.step(actions))
        ends += int(shown[2].sum())
        same(ours.reset_infos, loop.reset_infos)
    assert ends == 2 * ROWS
    same(ours.reset(), loop.reset())  # without new seeds the generators go on


def test_rows_are_seen_as_singles_are(both):
    ours, loop = both
    for env in both:
        env.seed(1)
        env.reset()
    same([image.copy() for image in ours.get_images()], list(loop.get_images()))
    same(ours.render(), loop.render())
    assert ours.env_is_wrapped(gymnasium.Wrapper, [0, 2]) == [False, False]
    assert ours.get_attr("num_envs", 1) == [ROWS]


def test_a_row_has_nothing_of_its_own():
    ours = BatchedVecEnv("nav", 2)
    with pytest.raises(NotImplementedError, match="share"):
        ours.set_attr("num_envs", 3, 0)
    with pytest.raises(NotImplementedError, match="share"):
        ours.env_method("reset", indices=0)
    ours.close()


def test_its_spaces_are_those_that_the_checker_accepts():
    ours, single = BatchedVecEnv("nav", 1), SingleEnv("nav", "rgb_array")
    with pytest.warns(UserWarning, match="minimal resolution"):
        check_env(single)
    assert ours.observation_space == single.observation_space
    assert ours.reset()[0] in single.observation_space


def test_a_monitor_counts_its_episodes():
    """What Stable-Baselines3's own logs and callbacks stand on."""
    env = VecMonitor(BatchedVecEnv("nav", 2))
    env.seed(0)
    env.reset()
    total = np.zeros(2)
    for _ in range(50):
        _, rewards, dones, infos = env.step(np.zeros((2, 2), np.float32))
        total += rewards
    assert dones.all()
    assert [info["episode"]["l"] for info in infos] == [50, 50]
    assert [info["episode"]["r"] for info in infos] == pytest.approx(total, rel=1e-4)
