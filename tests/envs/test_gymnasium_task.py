"""Gymnasium environments through a card: what they do is what the task does, or one clear line."""

import os
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from drawing import lacking
from gymnasium import spaces

from solar_cli.envs import build_task, drawable, picture
from solar_cli.envs.gymnasium_task import Camera
from solar_cli.episodes import roll_out
from solar_cli.errors import SolarError, UsageError
from solar_cli.pulse import Diverged
from solar_cli.settings import Observation, TaskSettings, load_card

mujoco_draws_here = pytest.mark.skipif(bool(lacking()), reason=lacking() or "it can be drawn")

LOW, HIGH = np.array([-1.0, 0.0], np.float32), np.array([3.0, 0.5], np.float32)


class Walk(gymnasium.Env):
    """Adds actions to a place (2,), and ends where its first entry is above 2."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = spaces.Box(-np.inf, np.inf, (2, 1))
    action_space = spaces.Box(LOW, HIGH)

    def __init__(
        self, fails_at=None, truncates_at=None, grows_at=None, odd_at=None, render_mode=None
    ):
        self.fails_at, self.truncates_at = fails_at, truncates_at
        self.grows_at, self.odd_at = grows_at, odd_at
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(size=2) + (options or {}).get("shift", 0.0)
        self.steps = 0
        return self.place[:, None], {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.steps += 1
        if self.steps == self.fails_at:
            raise RuntimeError("the floor\nis gone")
        self.place = self.place + action
        told = {"effort": float(np.square(action).sum())}
        over = bool(self.place[0] > 2.0)
        seen = self.place[:, None] if self.steps != self.grows_at else np.zeros((3, 1))
        if self.steps == self.odd_at:
            seen = seen * np.array([[1.0], [np.inf]])
        return seen, self.place[1], over, self.steps == self.truncates_at, told

    def render(self):
        """Twelve rows and eight columns: red says where it is, blue is the right half."""
        shown = np.zeros((12, 8, 3), np.uint8)
        shown[..., 0] = np.clip(50 * self.place[0], 0, 255)
        shown[:, 4:, 2] = 200
        return shown


class Choice(Walk):
    action_space = spaces.Discrete(3)


class Endless(Walk):
    action_space = spaces.Box(-np.inf, np.inf, (2,))


class Goals(Walk):
    observation_space = spaces.Dict({"place": spaces.Box(-1, 1, (2,)), "goal": spaces.Box(0, 1)})

    def reset(self, **given):
        place, info = super().reset(**given)
        return {"place": place[:, 0], "goal": np.zeros(1)}, info

    def step(self, action):
        place, *rest = super().step(action)
        return {"place": place[:, 0], "goal": np.zeros(1)}, *rest


class Blind(Walk):
    metadata = {"render_modes": []}  # noqa: RUF012


class Bare(Walk):
    """Knows nothing of rendering."""

    def __init__(self):
        super().__init__()


class Plain(Walk):
    def render(self):
        return "a picture"


KINDS = (Walk, Choice, Endless, Goals, Blind, Bare, Plain)
FAKES = {f"Test/{kind.__name__}-v0": kind for kind in KINDS}


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    for name, kind in FAKES.items():
        gymnasium.register(name, entry_point=kind)


def card(name="Test/Walk-v0", horizon=6, image=False, channels=3, size=2, bound=2.0, **parameters):
    seen = {"kind": "state", "width": 2}
    if image:
        seen = {"kind": "image", "height": 3, "width": 4, "channels": channels}
    return TaskSettings.model_validate(
        {
            "simulator": "gymnasium",
            "parameters": {"id": name, **parameters},
            "horizon": horizon,
            "action_cost": 0.5,
            "observation": {**seen, "window": 2},
            "action": {"size": size, "bound": bound},
            "exploration": {"std": 0.3},
        }
    )


def streams(count, seed=0):
    return [np.random.default_rng([seed, i]) for i in range(count)]


class Sure:
    """The same actions in every episode."""

    def __init__(self, actions):
        self.actions = np.asarray(actions)

    def start(self, episodes, stream):
        return None

    def act(self, observations, t, state):
        wanted = np.broadcast_to(self.actions[t], (len(observations), self.actions.shape[1]))
        return wanted, wanted, state


def rolled(settings, actions, count=5):
    return roll_out(build_task(settings), settings, Sure(actions), streams(count), None)


def by_hand(name, actions, count, **given):
    """Observations, rewards and infos of an environment that is used as Gymnasium says."""
    for stream in streams(count):
        env = gymnasium.make(name, disable_env_checker=True, **given)
        observation, info = env.reset(seed=int(stream.integers(2**31)))
        seen, rewards, infos = [observation.ravel()], [], [info]
        for action in actions:
            observation, reward, terminated, _, info = env.step(action)
            seen.append(observation.ravel())
            rewards.append(reward)
            infos.append(info)
            if terminated:
                break
        yield np.array(seen), np.array(rewards), infos


# What happens


@pytest.mark.parametrize(
    ("name", "size", "width", "bound"),
    [("Pusher-v5", 7, 23, 2.0), ("InvertedPendulum-v5", 1, 4, 3.0), ("Pendulum-v1", 1, 3, 2.0)],
)
def test_a_roll_out_is_stepping_the_environment_by_hand(name, size, width, bound):
    settings = card(name, horizon=15, size=size, bound=bound)
    settings = settings.model_copy(update={"observation": Observation(kind="state", width=width)})
    actions = np.random.default_rng(3).uniform(-bound, bound, (15, size))
    found = rolled(settings, actions, 3).episodes
    hand = by_hand(name, actions.astype(np.float32), 3)
    for i, (seen, rewards, _) in enumerate(hand):
        length = found.lengths[i]
        assert length == len(rewards)
        np.testing.assert_array_equal(found.frames[i, : length + 1], seen.astype(np.float32))
        np.testing.assert_array_equal(found.costs[i, :length], -rewards)


def test_actions_reach_from_one_side_of_the_box_to_the_other():
    for action, expected in (((-2, -2), LOW), ((2, 2), HIGH), ((0, 1), (1.0, 0.375))):
        frames = rolled(card(), [action] * 6).episodes.frames
        np.testing.assert_allclose(frames[:, 1] - frames[:, 0], [expected] * 5, atol=1e-6)


def test_an_episode_ends_where_the_environment_says_so():
    actions = np.tile([0.0, -2.0], (6, 1))  # one to the right in each step
    evaluation = rolled(card(), actions)
    episodes = evaluation.episodes
    assert episodes.lengths.tolist() == [2] * 5
    for t in range(3, 7):
        np.testing.assert_array_equal(episodes.frames[:, t], episodes.frames[:, 2])
    alive = np.tile([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0], (5, 1))
    np.testing.assert_array_equal(evaluation.measures["alive"], alive)


def test_an_end_with_the_last_step_leaves_no_dead_step():
    evaluation = rolled(card(horizon=2), np.tile([0.0, -2.0], (2, 1)))
    assert evaluation.episodes.live_steps.all()
    assert evaluation.measures["alive"][:, -1].tolist() == [0.0] * 5


def test_truncation_ends_an_episode_before_the_horizon_only():
    still = np.tile([-1.0, -2.0], (6, 1))
    assert rolled(card(make={"truncates_at": 4}), still).episodes.lengths.tolist() == [4] * 5
    evaluation = rolled(card(make={"truncates_at": 6}), still)
    assert evaluation.episodes.lengths.tolist() == [6] * 5
    assert evaluation.measures["alive"].all()


def test_an_episode_depends_on_its_stream_alone():
    settings = card()
    task = build_task(settings)
    moves = Sure(np.random.default_rng(0).uniform(-2, 2, (6, 2)))
    roll_out(task, settings, moves, streams(9, seed=4), None)
    again = roll_out(task, settings, moves, streams(5), None).episodes
    fresh = rolled(settings, moves.actions).episodes
    np.testing.assert_array_equal(again.frames, fresh.frames)
    np.testing.assert_array_equal(again.costs, fresh.costs)
    assert len(np.unique(fresh.frames[:, 0, 0])) == 5


def test_reset_options_are_handed_on():
    still = np.tile([-1.0, -2.0], (6, 1))
    plain, shifted = (rolled(card(reset=reset), still) for reset in ({}, {"shift": -0.5}))
    difference = shifted.episodes.frames - plain.episodes.frames
    np.testing.assert_allclose(difference, -0.5, atol=1e-6)


# What it costs


def test_a_cost_of_entries_is_of_the_state_before_the_step():
    terms = {"x": {"weight": 2.0, "target": 1.0}, "1": {"weight": 3.0}}
    settings = card(names=["x", "y"], cost=terms)
    actions = np.random.default_rng(0).uniform(-2, -1, (6, 2))
    found = rolled(settings, actions).episodes
    x, y = np.moveaxis(found.frames[:, :-1].astype(np.float64), -1, 0)
    expected = 2.0 * (x - 1.0) ** 2 + 3.0 * y**2 + 0.5 * np.square(actions).sum(axis=1)
    np.testing.assert_allclose(found.costs, expected, rtol=1e-5)


def test_nothing_is_added_to_minus_the_reward():
    actions = np.full((6, 2), -1.5)
    rewards = np.array([rewards for _, rewards, _ in by_hand("Test/Walk-v0", [LOW] * 6, 5)])
    found = rolled(card(cost="minus reward"), np.full((6, 2), -2.0)).episodes
    np.testing.assert_allclose(found.costs, -rewards)
    assert rolled(card(), actions).episodes.lengths.tolist() == [6] * 5


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({}, lambda last: 0 * last[:, 0]),
        ({"cost": {"0": {"weight": 2.0}}}, lambda last: 2.0 * last[:, 0] ** 2),
        ({"ended_cost": 7.0}, lambda last: 7.0 + 0 * last[:, 0]),
        ({"cost": {"0": {"weight": 2.0}}, "ended_cost": 0.0}, lambda last: 0 * last[:, 0]),
    ],
)
def test_steps_after_the_end_cost_what_the_card_says(parameters, expected):
    found = rolled(card(**parameters), np.tile([0.0, -2.0], (6, 1))).episodes
    last = found.frames[:, -1].astype(np.float64)
    for t in range(2, 6):
        np.testing.assert_allclose(found.costs[:, t], expected(last), rtol=1e-6)


# What is measured


def test_measures_are_entries_distances_and_what_a_step_tells():
    measures = {
        "place": {"entry": "x"},
        "far": {"norm": ["x", 1]},
        "gap": {"norm": ["x"], "minus": ["y"]},
        "effort": {"info": "effort"},
    }
    actions = np.random.default_rng(0).uniform(-2, -1, (6, 2))
    found = rolled(card(names=["x", "y"], measures=measures), actions)
    x, y = np.moveaxis(found.episodes.frames.astype(np.float64), -1, 0)
    np.testing.assert_allclose(found.measures["place"], x, rtol=1e-6)
    np.testing.assert_allclose(found.measures["far"], np.hypot(x, y), rtol=1e-6)
    np.testing.assert_allclose(found.measures["gap"], abs(x - y), rtol=1e-4)
    executed = np.diff(found.episodes.frames.astype(np.float64), axis=1)
    effort = np.square(executed).sum(axis=-1)
    np.testing.assert_allclose(found.measures["effort"][:, 1:], effort, rtol=1e-4)
    assert not found.measures["effort"][:, 0].any()
    assert found.truth_names == ("x", "y")
    np.testing.assert_allclose(found.truth, np.stack([x, y], axis=-1), rtol=1e-6)


# What is seen


def test_images_are_rendered_at_the_cards_size():
    settings = card(image=True)
    frames = rolled(settings, np.tile([0.0, -2.0], (6, 1))).episodes.frames
    truth = rolled(card(), np.tile([0.0, -2.0], (6, 1))).episodes.frames
    assert frames.shape == (5, 7, 3, 3, 4)
    red = np.trunc(np.clip(50 * truth[:, :, 0].astype(np.float64), 0, 255))
    np.testing.assert_allclose(frames[:, :, 0], np.broadcast_to(red[..., None, None], (5, 7, 3, 4)))
    assert not frames[:, :, 1].any()
    np.testing.assert_array_equal(frames[0, 0, 2], [[0, 0, 200, 200]] * 3)


def test_a_pixel_is_the_mean_of_the_area_it_covers():
    class Still(Walk):
        def render(self):
            return np.arange(9 * 6 * 3, dtype=np.uint8).reshape(9, 6, 3)

    shown = Still().render().astype(np.float64)
    half = Camera(Observation(height=3, width=3, channels=3)).frame(Still())
    expected = shown.reshape(3, 3, 3, 2, 3).mean(axis=(1, 3)).transpose(2, 0, 1)
    np.testing.assert_allclose(half, expected, atol=0.5 + 1e-9)
    odd = Camera(Observation(height=9, width=4, channels=1)).frame(Still())
    grey = shown @ [0.299, 0.587, 0.114]
    # Each of four columns covers one and a half of six.
    columns = [grey[:, [0, 1]] @ [2, 1], grey[:, [1, 2]] @ [1, 2]]
    columns += [grey[:, [3, 4]] @ [2, 1], grey[:, [4, 5]] @ [1, 2]]
    np.testing.assert_allclose(odd[0], np.stack(columns, axis=1) / 3, atol=0.5 + 1e-9)


def test_a_picture_for_people_is_in_the_frames_colours():
    frames = np.zeros((2, 3, 4, 5), np.uint8)
    frames[:, 1] = 255
    shown = picture(card(image=True), frames, 2)
    assert shown.shape == (2, 8, 10, 3)
    assert (shown == [0, 255, 0]).all()
    grey = picture(card(image=True, channels=1), frames[:, :1] + 100, 2)
    assert (grey == 100).all()


def pendulum(**make):
    """The card's task, a few steps of it, with arguments of its own."""
    task = load_card("inverted-pendulum").task
    parameters = {**task.parameters, "make": {"width": 64, "height": 64, **make}}
    return task.model_copy(update={"horizon": 3, "parameters": parameters})


def test_a_state_is_drawn_as_the_environment_renders_it_in_its_proportions():
    drawn = drawable(card(), 24)  # of 12 rows and 8 columns
    assert drawn.observation == Observation(kind="image", height=24, width=16, channels=3)
    moves = np.tile([-1.0, -2.0], (6, 1))
    seen, shown = rolled(card(), moves), rolled(drawn, moves)
    red = np.trunc(np.clip(50 * seen.episodes.frames[..., 0].astype(np.float64), 0, 255))
    np.testing.assert_allclose(shown.episodes.frames[:, :, 0, 12, 7], red)
    assert (shown.episodes.frames[..., 2, :, 8:] == 200).all()


@pytest.mark.filterwarnings("ignore:.*render_mode")
@pytest.mark.parametrize(("name", "why"), [("Blind", "renders no images"), ("Bare", "cannot make")])
def test_a_state_that_nothing_renders_is_not_drawn(name, why):
    with pytest.raises(UsageError, match=why):
        drawable(card(f"Test/{name}-v0"))


@pytest.mark.parametrize("gl", ["egl", "disabled"])
def test_states_need_no_graphics_library_and_pictures_say_that_they_do(gl):
    """In a process that finds none: MuJoCo's module of it fails as it does where it is missing."""
    program = (
        "import sys\n"
        "import numpy as np\n"
        "from solar_cli.envs import build_task, drawable\n"
        "from solar_cli.errors import UsageError\n"
        "from solar_cli.settings import load_card\n"
        "class Missing:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'mujoco.egl':\n"
        "            raise AttributeError('no eglQueryString')\n"
        "sys.meta_path.insert(0, Missing())\n"
        "settings = load_card('pusher').task\n"
        "task = build_task(settings)\n"
        "task.reset([np.random.default_rng(0)])\n"
        "print(np.isfinite(task.step(np.zeros((1, 7)))[0]).all())\n"
        "for seen in (settings, load_card('inverted-pendulum').task):\n"
        "    try:\n"
        "        build_task(drawable(seen))\n"
        "    except UsageError as error:\n"
        "        print(error)\n"
    )
    shown = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "MUJOCO_GL": gl},
        capture_output=True,
        text=True,
        check=True,
    )
    stepped, *refused = shown.stdout.splitlines()
    assert stepped == "True"
    assert len(refused) == 2
    assert all(line.startswith(f"MuJoCo cannot draw here, MUJOCO_GL is {gl}") for line in refused)
    assert shown.stderr == ""


@mujoco_draws_here
def test_an_image_is_what_the_environment_renders():
    make = load_card("inverted-pendulum").task.parameters["make"]
    settings, moves = pendulum(**make), Sure(np.full((3, 1), 0.5))
    frames = roll_out(build_task(settings), settings, moves, streams(2), None).episodes.frames
    env = gymnasium.make("InvertedPendulum-v5", render_mode="rgb_array", **make)
    for episode, stream in enumerate(streams(2)):
        env.reset(seed=int(stream.integers(2**31)))
        for t in range(4):
            np.testing.assert_array_equal(frames[episode, t], env.render().transpose(2, 0, 1))
            env.step(np.array([0.5], np.float32))
    env.close()


@mujoco_draws_here
def test_what_mujoco_draws_does_not_depend_on_what_was_drawn_before():
    """Two tasks draw in turn, from where they look by default, and one is gone in between."""
    settings = pendulum()
    moves = Sure(np.full((3, 1), 0.5))
    expected = roll_out(build_task(settings), settings, moves, streams(4), None).episodes.frames
    one, two = build_task(settings), build_task(settings)
    for task, seed in ((one, 1), (two, 2), (one, 3)):
        roll_out(task, settings, moves, streams(6, seed), None)
    del two
    again = roll_out(one, settings, moves, streams(4), None).episodes.frames
    np.testing.assert_array_equal(again, expected)
    assert expected.max() > 100


# What is refused


REFUSED = {
    "unknown key": ({"idd": 1}, ["unknown key 'task.parameters.idd'", "'id'"]),
    "no id": ({"name": None}, ["'task.parameters.id'"]),
    "unknown id": ({"name": "Test/Wolk-v0"}, ["'Test/Wolk-v0'", "did you mean 'Test/Walk-v0'"]),
    "far id": ({"name": "qqqqqqqq"}, ["'qqqqqqqq'", "import ="]),
    "package": ({"import": "no_such_package"}, ["task.parameters.import", "'no_such_package'"]),
    "argument": ({"make": {"fails": 3}}, ["Test/Walk-v0", "'fails'", "correct 'make'"]),
    "discrete": ({"name": "Test/Choice-v0"}, ["Discrete(3)", "only a Box"]),
    "unbounded": ({"name": "Test/Endless-v0"}, ["inf", "without bounds"]),
    "action size": ({"size": 3}, ["task.action", "set size = 2"]),
    "dict": ({"name": "Test/Goals-v0"}, ["Dict(", "only a Box can be read"]),
    "width": ({"name": "Pusher-v5", "size": 7}, ["(23,)", "set width = 23"]),
    "channels": ({"image": True, "channels": 2}, ["task.observation.channels = 2"]),
    "window": ({"horizon": 1}, ["task.observation.window = 2", "task.horizon = 1"]),
    "no images": ({"name": "Test/Blind-v0", "image": True}, ["renders no images", "state"]),
    "names": ({"names": ["x"]}, ["1 names for the 2 entries"]),
    "entry": ({"names": ["x", "y"], "cost": {"z": {"weight": 1}}}, ["cost.z", "known: x, y"]),
    "place": ({"cost": {"2": {"weight": 1.0}}}, ["cost.2", "0 to 1"]),
    "cost": ({"cost": "plus reward"}, ["task.parameters.cost", "minus reward"]),
    "term": ({"cost": {"0": {"wait": 1.0}}}, ["cost.0.wait", "did you mean 'weight'"]),
    "weight": ({"cost": {"0": {"weight": -1.0}}}, ["cost.0.weight", "-1.0"]),
    "measure": ({"measures": {"m": {}}}, ["measures.m", "one of entry, norm and info"]),
    "two in one": ({"measures": {"m": {"entry": 0, "info": "a"}}}, ["measures.m", "one of"]),
    "minus": ({"measures": {"m": {"norm": [0], "minus": [0, 1]}}}, ["measures.m", "minus"]),
    "info": ({"measures": {"m": {"info": "efort"}}}, ["measures.m", "did you mean 'effort'"]),
}


@pytest.mark.filterwarnings("ignore:.*render_mode")
@pytest.mark.parametrize(("changes", "parts"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_fit_is_refused_in_one_line(changes, parts):
    with pytest.raises(UsageError) as refused:
        build_task(card(**changes))
    message = str(refused.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_what_is_no_picture_is_refused():
    with pytest.raises(UsageError, match=r"Test/Plain-v0 fails at a reset .*renders str, not an"):
        build_task(card("Test/Plain-v0", image=True))


def test_an_environment_that_fails_from_the_start_is_a_card_to_correct():
    cause = r"task.parameters: Test/Walk-v0 fails in step 1 .*the floor.*install what.*'reset'"
    with pytest.raises(UsageError, match=cause):
        build_task(card(make={"fails_at": 1}))
    with pytest.raises(UsageError, match=r"fails at a reset .*renders str.*install what"):
        drawable(card("Test/Plain-v0"), 8)


def test_a_state_is_had_without_rendering():
    assert rolled(card("Test/Bare-v0"), np.full((6, 2), -1.5)).episodes.live_steps.all()


def test_a_goal_environment_can_be_learned_from_images():
    frames = rolled(card("Test/Goals-v0", image=True), np.full((6, 2), -1.5)).episodes.frames
    assert frames.shape == (5, 7, 3, 3, 4)


def test_a_step_that_fails_says_where_and_why():
    settings = card(make={"fails_at": 4})
    cause = r"Test/Walk-v0 fails in step 4 of an episode \(RuntimeError: the floor is gone\)"
    with pytest.raises(SolarError, match=cause):
        rolled(settings, np.full((6, 2), -1.5))


def test_an_observation_that_changes_its_size_says_where():
    cause = r"Test/Walk-v0 fails in step 3 of an episode \(ValueError: 3 numbers observed, 2 before"
    with pytest.raises(SolarError, match=cause):
        rolled(card(make={"grows_at": 3}), np.full((6, 2), -1.5))


def test_an_observation_that_is_not_finite_says_which_entry_and_where():
    with pytest.raises(Diverged, match=r"entry 1 of the observed state is -?inf at step 3"):
        rolled(card(make={"odd_at": 3}), np.full((6, 2), -1.5))


def test_what_images_do_not_show_and_nobody_reads_may_be_infinite():
    measured = {"measures": {"height": {"entry": 0}}}
    seen = rolled(card(image=True, make={"odd_at": 3}, **measured), np.full((6, 2), -1.5))
    assert np.isfinite(seen.measures["height"]).all()


@mujoco_draws_here
def test_graphics_that_are_missing_are_told_with_what_to_install(monkeypatch):
    settings = load_card("inverted-pendulum").task

    def broken(self, mode):
        raise RuntimeError("no display")

    from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

    monkeypatch.setattr(MujocoRenderer, "render", broken)
    with pytest.raises(UsageError, match=r"no display.*install libegl1"):
        build_task(settings)
