import math

import numpy as np
import pytest

from solar_cli.envs import build_task, car, picture
from solar_cli.envs.car import Car, CarFromImages
from solar_cli.errors import UsageError
from solar_cli.settings import TaskSettings, load_card

IMAGES = {
    "simulator": "car",
    "horizon": 100,
    "action_cost": 0.001,
    "observation": {"kind": "image", "height": 64, "width": 64, "channels": 1, "window": 4},
    "action": {"size": 2, "bound": 20.0},
    "exploration": {"std": 3.0},
}
STATES = IMAGES | {"observation": {"kind": "state", "width": 9}}
WORLD = Car(action_cost=0.001)
CAMERA = CarFromImages(action_cost=0.001, size=64)


def task(settings=STATES):
    return build_task(TaskSettings.model_validate(settings))


def streams(count, seed=0):
    return [np.random.default_rng([seed, i]) for i in range(count)]


def row(x=0.0, y=0.0, theta=0.0, v=0.0, phi=0.0):
    return np.array([[x, y, theta, v, phi]])


def driven(rows, actions, steps=1):
    for _ in range(steps):
        rows = WORLD.dynamics(rows, np.asarray(actions, float).reshape(-1, 2))
    return rows


def seen(rows):
    return CAMERA.draw(rows, CAMERA.scenes(rows))[:, 0].astype(float)


def car_alone(rows):
    """Frames without the target."""
    return CAMERA.draw(rows, np.zeros((len(rows), 1, 64, 64), np.uint8))[:, 0].astype(float)


def one_step(state, action):
    """The equations, one number at a time."""
    x, y, theta, v, phi = state
    v = max(-1.0, min(1.0, v + 0.1 * action[0]))
    phi = max(-math.pi / 4, min(math.pi / 4, phi + 0.1 * action[1]))
    return [
        max(-2.3, min(2.3, x + 0.1 * v * math.cos(theta))),
        max(-2.3, min(2.3, y + 0.1 * v * math.sin(theta))),
        theta + 0.1 * v * math.tan(phi),
        v,
        phi,
    ]


def test_a_step_is_semi_implicit_euler():
    draws = np.random.default_rng(0)
    rows = draws.uniform(-1, 1, (200, 5)) * (2.3, 2.3, 4.0, 1.0, math.pi / 4)
    actions = draws.normal(0, 3, (200, 2))
    expected = [one_step(*pair) for pair in zip(rows.tolist(), actions.tolist(), strict=True)]
    assert driven(rows, actions) == pytest.approx(np.array(expected), abs=1e-12)


@pytest.mark.parametrize("phi", [0.5, -0.7, math.pi / 4])
def test_constant_speed_and_steering_drive_a_circle(phi):
    # A polygon inscribed in a circle: its sides are 0.1 v, each turned by 0.1 v tan(phi).
    radius = 0.05 / math.sin(0.05 * math.tan(abs(phi)))
    assert radius == pytest.approx(1 / math.tan(abs(phi)), rel=1e-3)
    side = math.copysign(1.0, phi)
    turn = 0.1 * math.tan(phi)
    state = row(y=-side * radius, theta=turn / 2, v=1.0, phi=phi)
    for _ in range(150):
        state = driven(state, [0.0, 0.0])
        assert math.hypot(state[0, 0], state[0, 1]) == pytest.approx(radius)


def test_small_steps_approach_the_circle_of_the_wheelbase(monkeypatch):
    phi, seconds = 0.6, 3.0
    radius = 1 / math.tan(phi)
    angle = seconds / radius
    expected = (radius * math.sin(angle), radius * (1 - math.cos(angle)), angle)
    errors = []
    for step in (0.01, 0.005):
        monkeypatch.setattr(car, "STEP", step)
        end = driven(row(v=1.0, phi=phi), [0.0, 0.0], round(seconds / step))
        errors.append(np.abs(end[0, :3] - expected).max())
    assert errors[0] < 0.02
    assert errors[1] == pytest.approx(errors[0] / 2, rel=0.02)  # Euler is of first order


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ((2.25, 0.0, 0.0, 1.0), (2.3, 0.0)),
        ((-2.3, 1.0, math.pi, 1.0), (-2.3, 1.0)),
        ((0.0, -2.29, math.pi / 2, -1.0), (0.0, -2.3)),
        ((2.3, 0.0, math.pi / 3, 1.0), (2.3, 0.1 * math.sin(math.pi / 3))),  # along the wall
        ((2.3, 2.3, math.pi / 4, 1.0), (2.3, 2.3)),  # a corner
    ],
)
def test_walls_hold_the_centre_and_leave_speed_and_heading(start, end):
    x, y, theta, v = start
    moved = driven(row(x, y, theta, v), [0.0, 0.0])
    assert moved[0, :2] == pytest.approx(end, abs=1e-12)
    assert moved[0, 2:] == pytest.approx([theta, v, 0.0])


def test_speed_and_steering_have_limits():
    assert driven(row(), [50.0, -50.0])[0, 3:] == pytest.approx([1.0, -math.pi / 4])


def test_the_cards_bound_takes_nothing_away():
    settings = load_card("car").task
    bound = settings.action.bound
    # From the lowest speed to the highest in one step, and as for the steering: more is the same.
    slow = row(v=-1.0, phi=-math.pi / 4)
    assert np.array_equal(driven(slow, [bound, bound]), driven(slow, [9 * bound, 9 * bound]))
    assert bound > 6 * settings.exploration.std  # the first noise is never clipped


def test_episodes_start_in_the_bottom_right_facing_up():
    rows = np.stack([WORLD.initial(stream) for stream in streams(4000)])
    # Standard errors of 4000 draws: 0.0016 for a mean, 0.0011 for a deviation.
    assert rows[:, :3].mean(axis=0) == pytest.approx([1.5, -1.5, math.pi / 2], abs=0.008)
    assert rows[:, :3].std(axis=0) == pytest.approx([0.1] * 3, abs=0.006)
    assert not rows[:, 3:].any()


def test_the_cost_by_hand():
    # 3 and 4 away from (-2, 2).
    cost = WORLD.cost(row(1.0, -2.0), np.array([[3.0, -1.0]]))
    assert cost == pytest.approx([25.0 + 0.001 * 10.0], rel=1e-12)
    assert WORLD.measures(row(1.0, -2.0))["distance"] == pytest.approx([5.0])


def test_the_cost_is_that_of_the_state_before():
    run = task()
    run.reset(streams(1))
    x, y = run.truth()[0, :2]
    _, costs = run.step(np.array([[30.0, 0.0]]))
    # The action is clipped to (20, 0).
    assert costs[0] == pytest.approx((x + 2) ** 2 + (y - 2) ** 2 + 0.4, rel=1e-12)


def test_the_target_can_be_reached_within_the_horizon():
    rows = np.stack([WORLD.initial(stream) for stream in streams(50)])
    total = np.zeros(50)
    for _ in range(100):
        # Steer towards the target, and slow down before it.
        across, up = -2.0 - rows[:, 0], 2.0 - rows[:, 1]
        error = np.angle(np.exp(1j * (np.arctan2(up, across) - rows[:, 2])))
        wanted = np.stack([np.hypot(across, up), 2.0 * error], axis=1)
        actions = np.clip(10.0 * (wanted.clip([0, -0.75], [1, 0.75]) - rows[:, 3:]), -20, 20)
        total += WORLD.cost(rows, actions)
        rows = WORLD.dynamics(rows, actions)
    assert WORLD.measures(rows)["distance"].max() < 0.1
    assert total.mean() < 500  # standing still costs 2450


def test_a_state_has_the_nine_numbers_of_e_2():
    run = task()
    run.reset(streams(3))
    for _ in range(4):
        frames, _ = run.step(np.array([[2.0, 1.0], [-3.0, 0.5], [0.0, -1.0]]))
    x, y, cos, sin, v, cos_phi, sin_phi, goal_x, goal_y = frames.astype(float).T
    assert np.stack([x, y, cos, sin], axis=1) == pytest.approx(run.truth(), abs=1e-6)
    assert v == pytest.approx([0.8, -1.0, 0.0])
    assert np.arctan2(sin_phi, cos_phi) == pytest.approx([0.4, 0.2, -0.4], abs=1e-6)
    assert cos_phi**2 + sin_phi**2 == pytest.approx(1.0)
    assert (goal_x == -2.0).all()
    assert (goal_y == 2.0).all()


def test_images_and_states_are_of_the_same_world():
    moves = np.random.default_rng(2).normal(0, 3, (20, 3, 2))
    one, two = task(IMAGES), task(STATES)
    one.reset(streams(3))
    two.reset(streams(3))
    for move in moves:
        assert np.array_equal(one.step(move)[1], two.step(move)[1])
    assert np.array_equal(one.truth(), two.truth())


def supersampled(x, y, theta):
    """The scene from 16 x 16 points a pixel, painted one thing over the other."""
    places = ((np.arange(64 * 16) + 0.5) / 16 - 32) / 12
    east, north = np.meshgrid(places, -places)
    ahead = (east - x) * math.cos(theta) + (north - y) * math.sin(theta)
    left = (north - y) * math.cos(theta) - (east - x) * math.sin(theta)
    image = np.where((east + 2) ** 2 + (north - 2) ** 2 <= 0.107**2, 255.0, 0.0)
    for axle in (-0.36, 0.36):
        image[(abs(ahead - axle) <= 0.16) & (abs(left) <= 0.38)] = 128
    image[(abs(ahead) <= 0.6) & (abs(left) <= 0.3)] = 255
    image[(abs(ahead - 0.2) <= 0.12) & (abs(left) <= 0.24)] = 0
    return image.reshape(64, 16, 64, 16).mean(axis=(1, 3))


def test_a_frame_is_as_one_drawn_from_many_points():
    draws = np.random.default_rng(3)
    rows = np.zeros((20, 5))
    rows[:, :3] = draws.uniform(-1, 1, (20, 3)) * (2.3, 2.3, 4.0)
    rows[0, :2], rows[1, :2] = (-2.0, 2.0), (2.3, -2.3)  # over the target, in a corner
    errors = np.stack([seen(rows)[i] - supersampled(*rows[i, :3]) for i in range(20)])
    # Of 255; a car covers 1 pixel in 40, so that 0.2 is about 8 grey levels of each of its pixels.
    assert np.abs(errors).mean(axis=(1, 2)).max() < 0.2
    assert abs(errors.mean()) < 0.05


def test_ink_and_its_centre_are_those_of_the_shapes():
    headings = np.linspace(-3, 3, 13)
    rows = np.zeros((13, 5))
    rows[:, 0], rows[:, 1], rows[:, 2] = 0.31, -0.47, headings
    frames = car_alone(rows)
    body, windscreen, wheels = 1.2 * 0.6, 0.24 * 0.48, 4 * 0.32 * 0.08
    ink = 144 * (255 * (body - windscreen) + 128 * wheels)
    assert frames.sum(axis=(1, 2)) == pytest.approx(ink, rel=0.02)
    # The dark windscreen is 0.2 ahead of the centre: the ink lies behind it.
    behind = 144 * 255 * windscreen * 0.2 / ink
    column = (frames.sum(axis=1) @ np.arange(64)) / frames.sum(axis=(1, 2))
    line = (frames.sum(axis=2) @ np.arange(64)) / frames.sum(axis=(1, 2))
    across = (column - 31.5) / 12 - rows[:, 0]
    up = (31.5 - line) / 12 - rows[:, 1]
    assert across == pytest.approx(-behind * np.cos(headings), abs=0.005)
    assert up == pytest.approx(-behind * np.sin(headings), abs=0.005)


WALLS = [(2.3, 0.4), (-2.3, -0.4), (0.4, 2.3), (-0.4, -2.3), (2.3, 2.3), (-2.3, 2.3)]


@pytest.mark.parametrize("place", [(0.0, 0.0), *WALLS])
def test_front_and_rear_can_be_told_apart_wherever_the_car_is(place):
    rows = np.zeros((24, 5))
    rows[:, :2], rows[:, 2] = place, np.linspace(-np.pi, np.pi, 24, endpoint=False)
    frames, whole = car_alone(rows), car_alone(row())
    visible = frames.sum(axis=(1, 2)) / whole.sum()
    assert visible.min() > (0.98 if place == (0.0, 0.0) else 0.6)
    turned = np.roll(frames, 12, axis=0)  # half a turn
    different = np.abs(frames - turned).sum(axis=(1, 2)) / whole.sum()
    assert different.min() > 0.15


@pytest.mark.parametrize("entry", [0, 1])
@pytest.mark.parametrize("settings", [IMAGES, STATES])
def test_the_next_frame_already_depends_on_the_action(settings, entry):
    run = task(settings)
    frames = []
    for change in (-0.5, 0.5):
        run.reset(streams(8))
        for _ in range(5):  # to a speed of 0.5
            run.step(np.tile([1.0, 0.0], (8, 1)))
        action = np.zeros((8, 2))
        action[:, entry] = change
        frames.append(run.step(action)[0].astype(float))
    difference = np.abs(frames[1] - frames[0]).reshape(8, -1).max(axis=1)
    # 0.1 of v or phi, of which the image shows 0.01 of place or 0.005 of heading: a tenth of a
    # pixel, or a thirtieth where the car ends. Rounding alone is 1.
    assert (difference > (3.0 if settings is IMAGES else 0.0999)).all()


def test_the_world_is_symmetric_in_the_image():
    place = row(0.37, -1.21, 0.8)
    opposite = row(-0.37, 1.21, 0.8 + np.pi)
    assert car_alone(opposite) == pytest.approx(car_alone(place)[:, ::-1, ::-1], abs=1)


def test_a_larger_image_shows_the_same_world():
    large = CarFromImages(0.001, 128)
    rows = np.stack([WORLD.initial(stream) for stream in streams(10)])
    frames = large.draw(rows, large.scenes(rows))[:, 0].astype(float)
    averaged = frames.reshape(10, 64, 2, 64, 2).mean(axis=(2, 4))
    assert np.abs(averaged - seen(rows)).mean() < 0.2


@pytest.mark.parametrize("settings", [IMAGES, STATES])
def test_people_see_a_dark_car_and_a_blue_target(settings):
    run = task(settings)
    frames = run.reset(streams(1))
    image = picture(TaskSettings.model_validate(settings), frames, 8)
    assert (image.shape, image.dtype) == ((1, 512, 512, 3), np.uint8)
    x, y, cos, sin = run.truth()[0]
    behind = image[0, round(256 - 96 * (y - 0.3 * sin)), round(256 + 96 * (x - 0.3 * cos))]
    windscreen = image[0, round(256 - 96 * (y + 0.2 * sin)), round(256 + 96 * (x + 0.2 * cos))]
    red, green, blue = image[0, 256 - 192, 256 - 192].astype(int)
    assert behind.max() < 90
    assert windscreen.min() > 165
    assert blue > 200 > green > red
    assert (image[0, 256, 128] == 255).all()


def test_pictures_of_images_and_of_states_agree():
    one, two = (TaskSettings.model_validate(settings) for settings in (IMAGES, STATES))
    images, states = build_task(one).reset(streams(6)), build_task(two).reset(streams(6))
    shape = (2, 3)
    enlarged = picture(one, images.reshape(*shape, 1, 64, 64), 4).astype(float)
    drawn = picture(two, states.reshape(*shape, 9), 4).astype(float)
    assert enlarged.shape == drawn.shape == (2, 3, 256, 256, 3)
    assert np.abs(enlarged - drawn).mean() < 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": {"goal": [0.0, 0.0]}}, "no parameter 'goal'"),
        ({"action": {"size": 1, "bound": 20.0}}, "size = 2"),
        ({"observation": {"kind": "state", "width": 5}}, "width = 9"),
        ({"observation": IMAGES["observation"] | {"channels": 3}}, "channels = 1"),
        ({"observation": IMAGES["observation"] | {"height": 32}}, "height = width"),
    ],
)
def test_what_does_not_fit_is_named(change, message):
    with pytest.raises(UsageError, match=message) as caught:
        task(IMAGES | change)
    assert "\n" not in str(caught.value)
