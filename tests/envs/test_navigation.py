import numpy as np
import pytest

from solar_cli.envs import build_task, picture
from solar_cli.envs.navigation import Navigation
from solar_cli.errors import UsageError
from solar_cli.settings import TaskSettings

SETTINGS = {
    "simulator": "navigation",
    "horizon": 50,
    "action_cost": 0.001,
    "parameters": {"goal": "moving"},
    "observation": {"kind": "image", "height": 32, "width": 32, "channels": 2},
    "action": {"size": 2, "bound": 1.0},
    "exploration": {"std": 0.1},
}
FIXED = SETTINGS | {"parameters": {"goal": [1.0, -1.0]}}
WORLD = Navigation(goal=None, action_cost=0.001, size=32)


def task(settings=SETTINGS):
    return build_task(TaskSettings.model_validate(settings))


def streams(count, seed=0):
    return [np.random.default_rng([seed, i]) for i in range(count)]


def test_a_move_in_the_room_is_a_plain_sum():
    rows = np.random.default_rng(0).uniform(-1.4, 1.4, (50, 4))
    actions = np.random.default_rng(1).uniform(-1.4, 1.4, (50, 2))
    moved = WORLD.dynamics(rows, actions)
    assert np.array_equal(moved, np.hstack([rows[:, :2] + actions, rows[:, 2:]]))


@pytest.mark.parametrize(
    ("start", "action", "end"),
    [
        ((2.5, 0.0), (0.5, 0.25), (2.6, 0.25)),  # 0.2 beyond the right wall
        ((-2.5, 0.0), (-1.0, 0.0), (-2.1, 0.0)),  # 0.7 beyond the left wall
        ((2.7, -2.7), (0.4, -0.6), (2.5, -2.3)),  # into a corner: both coordinates
        ((0.0, 2.8), (0.0, 1.0), (0.0, 1.8)),  # from the top wall itself
    ],
)
def test_walls_reflect(start, action, end):
    moved = WORLD.dynamics(np.array([[*start, 0.0, 0.0]]), np.array([action]))
    assert moved[0, :2] == pytest.approx(end, abs=1e-12)


def test_the_cost_is_that_of_the_state_before_and_of_the_action_as_executed():
    run = task(FIXED)
    run.reset(streams(1))
    x, y = run.truth()[0, :2]
    _, costs = run.step(np.array([[3.0, -0.5]]))
    # The action is clipped to (1, -0.5).
    assert costs[0] == pytest.approx((x - 1) ** 2 + (y + 1) ** 2 + 0.001 * (1 + 0.25), rel=1e-12)
    assert run.truth()[0, :2] == pytest.approx([x + 1, y - 0.5])


def test_the_cost_by_hand():
    assert WORLD.cost(np.array([[1.0, 2.0, 0.0, -1.0]]), np.array([[0.5, 1.0]])) == 10.00125


def test_the_goal_is_where_the_card_puts_it():
    run = task(FIXED)
    run.reset(streams(20))
    assert np.array_equal(run.truth()[:, 2:], np.tile([1.0, -1.0], (20, 1)))


def test_both_kinds_of_goal_share_their_starts():
    moving, fixed = task(), task(FIXED)
    moving.reset(streams(20))
    fixed.reset(streams(20))
    assert np.array_equal(moving.truth()[:, :2], fixed.truth()[:, :2])


def test_the_distance_is_between_agent_and_goal():
    run = task()
    run.reset(streams(5))
    x, y, goal_x, goal_y = run.truth().T
    assert run.measures()["distance"] == pytest.approx(np.hypot(x - goal_x, y - goal_y))


def test_scale_of_a_random_walk():
    run = task()
    run.reset(streams(4000))
    # Mean distance of two uniform points in a unit square, times its side; the standard error
    # of 4000 episodes is 0.008.
    assert run.measures()["distance"].mean() == pytest.approx(2 * 0.5214054, abs=0.02)
    noise = np.random.default_rng(5)
    for _ in range(run.horizon):
        run.step(noise.normal(0.0, 0.1, (4000, 2)))
    assert run.measures()["distance"].mean() == pytest.approx(1.36, abs=0.04)


@pytest.mark.parametrize("channel", [0, 1])
def test_blobs_are_where_agent_and_goal_are(channel):
    run = task()
    frames = run.reset(streams(50))
    mass = frames[:, channel].astype(float)
    mass /= mass.sum(axis=(1, 2), keepdims=True)
    x, y = run.truth()[:, 2 * channel : 2 * channel + 2].T
    # 5 pixels a unit around the middle of 32 pixels; row 0 is at the top.
    assert np.abs(mass.sum(axis=1) @ np.arange(32) - (15.5 + 5 * x)).max() < 0.02
    assert np.abs(mass.sum(axis=2) @ np.arange(32) - (15.5 - 5 * y)).max() < 0.02


def test_the_world_is_symmetric_in_the_image():
    point = np.array([[0.37, -1.21, 2.8, 0.4]])
    frame = WORLD.draw(point, WORLD.scenes(point))
    mirrored = WORLD.draw(-point, WORLD.scenes(-point))
    assert np.array_equal(mirrored, frame[..., ::-1, ::-1])
    assert frame[0, 0].max() > 200


def test_a_larger_image_shows_the_same_world():
    settings = SETTINGS | {"observation": SETTINGS["observation"] | {"height": 64, "width": 64}}
    small, large = task(), task(settings)
    small_frames, large_frames = small.reset(streams(10)), large.reset(streams(10))
    # Four small pixels for one: about four times the light.
    ratio = large_frames.sum(axis=(2, 3)) / small_frames.sum(axis=(2, 3))
    assert ratio == pytest.approx(4.0, rel=0.01)


def test_people_see_a_dark_agent_and_a_blue_goal_in_a_room():
    settings = TaskSettings.model_validate(FIXED)
    run = build_task(settings)
    frames = run.reset(streams(1))
    image = picture(settings, frames, 8)
    assert image.shape == (1, 256, 256, 3)
    assert image.dtype == np.uint8
    x, y = run.truth()[0, :2]
    agent = image[0, round(128 - 40 * y), round(128 + 40 * x)]
    red, green, blue = image[0, 128 + 40, 128 + 40].astype(int)
    assert agent.max() < 90
    assert blue > 200 > green > red
    assert (image[0, 0] == image[0, 0, 0]).all()
    assert image[0, 0, 0].max() < 230
    assert (image[0, 20, 20] == 255).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"simulator": "navigaton"}, "did you mean 'navigation'"),
        ({"parameters": {"gaol": "moving"}}, "did you mean 'goal'"),
        ({"parameters": {"goal": "left"}}, "expected 'moving' or"),
        ({"parameters": {"goal": [1.0]}}, "expected 'moving' or"),
        ({"parameters": {"goal": [9.0, 0.0]}}, "within"),
        ({"parameters": {"goal": [True, 0.0]}}, "expected 'moving' or"),
        ({"action": {"size": 3, "bound": 1.0}}, "size = 2"),
        ({"action": {"size": 2, "bound": 6.0}}, "bound <= 5.6"),
        ({"observation": {"kind": "state", "width": 4}}, "square images"),
        ({"observation": SETTINGS["observation"] | {"height": 16}}, "height = width"),
    ],
)
def test_what_does_not_fit_is_named(change, message):
    with pytest.raises(UsageError, match=message) as caught:
        task(SETTINGS | change)
    assert "\n" not in str(caught.value)
