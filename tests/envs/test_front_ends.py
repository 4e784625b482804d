import sys
import types
import warnings

import gymnasium
import numpy as np
import pytest
from drawing import skip_if_it_cannot_be_drawn
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from solar_cli.envs import SIMULATORS, build_task
from solar_cli.envs.front_ends import IDS, BatchedEnv, SingleEnv, task_settings
from solar_cli.envs.task import RowTask
from solar_cli.settings import load_card

ROWS = 5


@pytest.fixture(params=sorted(IDS))
def name(request):
    skip_if_it_cannot_be_drawn(task_settings(IDS[request.param]))
    if IDS[request.param] == "sawyer":
        pytest.importorskip("pybullet")
    return request.param


def both(name, **kwargs):
    """The batched form, and Gymnasium's own loop over singles."""
    batched = gymnasium.make_vec(name, num_envs=ROWS, **kwargs)
    loop = gymnasium.make_vec(
        name,
        num_envs=ROWS,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        **kwargs,
    )
    assert isinstance(batched, BatchedEnv)
    return batched, loop


def same(one, two):
    """Equal in structure, type and every bit."""
    assert type(one) is type(two)
    if isinstance(one, dict):
        assert one.keys() == two.keys()
        for key in one:
            same(one[key], two[key])
    elif isinstance(one, tuple) or (isinstance(one, np.ndarray) and one.dtype == object):
        assert len(one) == len(two)
        for left, right in zip(one, two, strict=True):
            same(left, right)
    elif isinstance(one, np.ndarray):
        assert one.dtype == two.dtype
        assert np.array_equal(one, two)
    else:
        assert one == two


def actions(steps, task):
    """Some beyond the bounds, in the action space's type."""
    shape, bound = (steps, ROWS, task.action.size), 1.3 * task.action.bound
    noise = np.random.default_rng(0).uniform(-bound, bound, shape)
    return noise.astype(np.float32)


def test_the_batched_form_equals_a_loop_over_singles(name):
    batched, loop = both(name)
    task = load_card(IDS[name]).task
    same(batched.reset(seed=11), loop.reset(seed=11))
    restarts = 0
    for action in actions(2 * task.horizon + 10, task):
        shown = batched.step(action)
        same(shown, loop.step(action))
        restarts += shown[3].sum()
    assert restarts == 2 * ROWS
    same(batched.reset(), loop.reset())
    same(batched.reset(seed=[3, None, 5, None, 7]), loop.reset(seed=[3, None, 5, None, 7]))


def test_they_stay_equal_when_rows_end_at_different_times(name):
    batched, loop = both(name, max_episode_steps=20)
    same(batched.reset(seed=4), loop.reset(seed=4))
    seen = set()
    for step, action in enumerate(actions(40, load_card(IDS[name]).task)):
        if step in (3, 9):
            mask = np.arange(ROWS) % (step - 1) == 0
            same(
                batched.reset(options={"reset_mask": mask}),
                loop.reset(options={"reset_mask": mask}),
            )
        shown = batched.step(action)
        same(shown, loop.step(action))
        seen.add(int(shown[3].sum()))
    assert {0, 1} <= seen
    assert ROWS not in seen


def test_the_spaces_equal_those_of_a_loop(name):
    batched, loop = both(name)
    for space in ("observation_space", "action_space"):
        assert getattr(batched, space) == getattr(loop, space)
        assert getattr(batched, f"single_{space}") == getattr(loop, f"single_{space}")
    observation, _ = batched.reset(seed=0)
    assert observation in batched.observation_space


def test_each_id_is_its_card(name):
    task = load_card(IDS[name]).task
    env = gymnasium.make(name)
    shown = {
        "nav": gymnasium.spaces.Box(0, 255, (2, 32, 32), np.uint8),
        "nav-fixed": gymnasium.spaces.Box(0, 255, (2, 32, 32), np.uint8),
        "car": gymnasium.spaces.Box(0, 255, (4, 64, 64), np.uint8),
        "sawyer": gymnasium.spaces.Box(0, 255, (3, 84, 84), np.uint8),
        "reacher": gymnasium.spaces.Box(0, 255, (12, 64, 64), np.uint8),
        "car-states": gymnasium.spaces.Box(-np.inf, np.inf, (9,), np.float32),
    }
    assert env.spec.max_episode_steps == task.horizon
    assert env.observation_space == shown[IDS[name]]
    bound = task.action.bound
    assert env.action_space == gymnasium.spaces.Box(-bound, bound, (task.action.size,), np.float32)


def test_an_id_means_its_own_card_in_every_folder(tmp_path, monkeypatch):
    wanted = task_settings("nav")
    (tmp_path / "tasks").mkdir()
    text = load_card("nav").path.read_text().replace("horizon = 50", "horizon = 7")
    (tmp_path / "tasks" / "nav.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    assert load_card("nav").task.horizon == 7
    assert task_settings("nav") == wanted


def test_an_episode_is_truncated_at_the_horizon_and_pays_minus_the_cost(name):
    env, task = gymnasium.make(name), build_task(task_settings(IDS[name]))
    env.reset(seed=2)
    task.reset([gymnasium.utils.seeding.np_random(2)[0]])
    for step in range(1, task.horizon + 1):
        action = env.action_space.sample()
        _, reward, terminated, truncated, info = env.step(action)
        _, (paid,) = task.step(action[None].astype(float))
        assert reward == -paid
        assert info == {key: value[0] for key, value in task.measures().items()}
        assert not terminated
        assert truncated == (step == task.horizon)


def test_an_id_is_found_by_module_and_name():
    env = gymnasium.make("solar_cli.envs.front_ends:Solar/Navigation-v0")
    assert isinstance(env.unwrapped, SingleEnv)


def accepted(name):
    """What a checker may recommend: actions have their card's units, a state has no bounds."""
    task = load_card(IDS[name]).task
    messages = []
    if task.action.bound != 1.0:
        messages += [".*we recommend using a symmetric and normalized space"]
        messages += ["We recommend you to use a symmetric and normalized Box action space"]
    if task.observation.kind == "state":
        messages += [".*A Box observation space (minimum|maximum) value is -?infin"]
    elif task.observation.width < 36:
        # The default network of Stable-Baselines needs 36 pixels; the paper's images have 32.
        messages += ["The minimal resolution for an image is 36x36"]
    return messages


def test_gymnasiums_checker_has_nothing_else_to_say(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for message in accepted(name):
            warnings.filterwarnings("ignore", message=message)
        check_env(gymnasium.make(name).unwrapped)


def test_stable_baselines_checker_has_nothing_else_to_say(name):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for message in accepted(name):
            warnings.filterwarnings("ignore", message=message)
        checker.check_env(gymnasium.make(name).unwrapped, skip_render_check=False)


def test_a_person_sees_a_picture(name):
    env = gymnasium.make(name, render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    side = 8 * task_settings(IDS[name]).observation.height if "States" not in name else 512
    assert (image.shape, image.dtype) == ((side, side, 3), np.uint8)
    batched = gymnasium.make_vec(name, num_envs=3, render_mode="rgb_array")
    batched.reset(seed=0)
    images = batched.render()
    assert len(images) == 3
    same(images[0], image)


def test_the_batched_form_refuses_a_wrong_number_of_seeds():
    with pytest.raises(ValueError, match="3 seeds for 5 rows"):
        gymnasium.make_vec("Solar/Navigation-v0", num_envs=ROWS).reset(seed=[1, 2, 3])


def test_the_batched_form_needs_no_seed():
    one, two = (gymnasium.make_vec("Solar/Navigation-v0", num_envs=2).reset() for _ in range(2))
    assert not np.array_equal(one[0], two[0])
    assert not np.array_equal(one[0][0], one[0][1])


@pytest.fixture
def windowed(tmp_path):
    """A card like nav whose observations hold three frames."""
    text = load_card("nav").path.read_text().replace("channels = 2", "channels = 2\nwindow = 3", 1)
    path = tmp_path / "three.toml"
    path.write_text(text)
    return str(path)


def test_a_window_holds_the_newest_frames_oldest_first(windowed):
    long, short = SingleEnv(windowed, "rgb_array"), SingleEnv("nav", "rgb_array")
    frames = [short.reset(seed=6)[0]] * 3
    observation, _ = long.reset(seed=6)
    for action in actions(6, load_card("nav").task)[:, 0]:
        assert observation.shape == (6, 32, 32)
        assert np.array_equal(observation, np.concatenate(frames[-3:]))
        assert np.array_equal(long.render(), short.render())
        observation.fill(9)  # what a user does to it must not come back
        observation = long.step(action)[0]
        frames.append(short.step(action)[0])


def test_windows_of_the_batched_form_start_anew_with_their_row(windowed):
    batched = BatchedEnv(windowed, num_envs=ROWS, max_episode_steps=4)
    loop = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.wrappers.TimeLimit(SingleEnv(windowed), 4)] * ROWS,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    same(batched.reset(seed=1), loop.reset(seed=1))
    for action in actions(10, load_card("nav").task):
        same(batched.step(action), loop.step(action))


class Rail:
    """A point on a line, seen as a number."""

    truth_names = ("x",)

    def initial(self, stream):
        return stream.normal(size=1)

    def dynamics(self, rows, actions):
        return rows + actions

    def cost(self, rows, actions):
        return rows[:, 0] ** 2

    def scenes(self, rows):
        return np.empty((len(rows), 0), np.float32)

    def draw(self, rows, scenes):
        return rows.astype(np.float32)

    def measures(self, rows):
        return {}

    def truth(self, rows):
        return rows.copy()


def test_a_task_of_states_is_an_environment_too(tmp_path, monkeypatch):
    module = types.ModuleType("rail")
    module.build = lambda settings: RowTask(Rail(), settings)
    monkeypatch.setitem(sys.modules, "rail", module)
    monkeypatch.setitem(SIMULATORS, "rail", "rail")
    card = tmp_path / "rail.toml"
    card.write_text(
        'summary = "Stay in the middle."\n'
        '[task]\nsimulator = "rail"\nhorizon = 8\nexploration.std = 0.1\n'
        'observation = { kind = "state", width = 1, window = 2 }\n'
        "action = { size = 1, bound = 1.0 }\n"
    )
    env = SingleEnv(str(card))
    assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    assert info == {}
    following = env.step(np.array([0.5], np.float32))[0]
    assert following == pytest.approx([observation[1], observation[1] + 0.5])
