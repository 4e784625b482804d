"""Stacking: a script that knows the true poses stacks in both engines; costs; bits; bad cards."""

import hashlib
import subprocess
import sys
import tempfile

import numpy as np
import pytest
from sawyer_worlds import SIDE, make_world

from solar_cli.envs import build_task, picture
from solar_cli.envs.sawyer import facts
from solar_cli.envs.sawyer.control import Pose, rotation
from solar_cli.envs.sawyer.stacking import Stacking
from solar_cli.errors import UsageError
from solar_cli.settings import load_card

SEATED, ON_STUDS = facts.HEIGHT, facts.HEIGHT + facts.STUD_HEIGHT


def card(**changes):
    return load_card("sawyer").task.model_copy(update=changes)


def task(engine, **parameters):
    make_world(engine)  # or skip
    return build_task(card(parameters={"backend": engine, **parameters}))


def streams(count, seed=0):
    return [np.random.default_rng([seed, i]) for i in range(count)]


def script(truth, aside=0.0):
    """Actions (N, 4) for true poses (N, 6): go above the lower brick, then press."""
    goal = truth[:, 4:] + [aside, 0.0]
    off = goal - truth[:, :2]
    aligned = np.hypot(*off.T) < 0.003
    height = np.where(aligned, SEATED - 0.004, ON_STUDS + 0.01) + facts.HEIGHT / 2
    wanted = np.column_stack([off, height - truth[:, 2]]) / 0.1
    return np.clip(4.0 * np.column_stack([wanted, -truth[:, 3] / 0.5]), -1, 1)


def stack(task, count, aside=0.0):
    """Heights (T, N) of one brick over the other, and the last measures."""
    task.reset(streams(count))
    heights = []
    for _ in range(task.horizon):
        task.step(script(task.truth(), aside))
        heights.append(task.truth()[:, 2] - facts.HEIGHT / 2)
    return np.array(heights), task.measures()


def test_who_knows_the_true_poses_stacks(engine):
    heights, measures = stack(task(engine), 3)
    assert (measures["stacked"] == 1.0).all()
    assert (measures["distance"] < 0.25).all()
    assert ((heights[-1] > 0.0186) & (heights[-1] < 0.0192)).all()
    assert heights.min() > 0.0186  # never pressed into the other


def test_who_misses_stays_on_the_studs(engine):
    heights, measures = stack(task(engine), 3, aside=0.006)
    assert (measures["stacked"] == 0.0).all()
    assert heights[-1] == pytest.approx(np.full(3, ON_STUDS), abs=0.0013)  # it rocks


def test_the_table_holds(engine):
    rows = task(engine)
    rows.reset(streams(1))
    for _ in range(20):
        rows.step(np.array([[1.0, 0.0, -1.0, 0.0]]))
    assert rows.truth()[0, 2] == pytest.approx(facts.HEIGHT / 2, abs=1e-4)


def test_episodes_start_where_they_should(engine):
    rows = task(engine)
    rows.reset(streams(6))
    start, away = rows.truth(), rows.measures()["distance"]
    assert ((away > 8.0) & (away < 15.0)).all()
    assert (rows.measures()["stacked"] == 0.0).all()
    assert (np.abs(start[:, 4:] - [0.6, 0.0]) <= 0.002).all()
    from_seat = start[:, :3] - [0.6, 0.0, 1.5 * facts.HEIGHT]
    assert (np.abs(from_seat - [0.05, -0.04, 0.09]) <= 0.01 + 1e-6).all()
    assert (np.abs(start[:, 3] - 0.15) <= 0.05 + 1e-6).all()


def test_the_lower_brick_shifts_as_far_as_the_card_says(engine):
    for jitter in (0.0, 0.02):
        rows = task(engine, jitter=jitter)
        rows.reset(streams(5))
        off = np.abs(rows.truth()[:, 4:] - [0.6, 0.0])
        assert off.max() <= jitter + 1e-12
        assert off.max() >= 0.6 * jitter


def episode(rows, count=2):
    """Bits of all that is seen of episodes that end in contact."""
    seen = [rows.reset(streams(count, seed=5))]
    for _ in range(16):
        seen += rows.step(script(rows.truth()))
    return hashlib.sha256(b"".join(part.tobytes() for part in [*seen, rows.truth()])).hexdigest()


def press(rows, count, seed):
    rows.reset(streams(count, seed=seed))
    for _ in range(14):
        rows.step(script(rows.truth(), aside=0.004))


def test_an_episode_has_the_same_bits_whatever_ran_before_or_beside(engine):
    rows = task(engine)
    expected = episode(rows)
    press(rows, 3, seed=1)
    assert episode(rows) == expected
    other = task(engine)
    press(other, 1, seed=2)
    assert episode(other) == expected
    assert episode(rows) == expected


def test_an_episode_has_the_same_bits_in_another_process(engine):
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import test_sawyer as t\n"
        "print(t.episode(t.task(sys.argv[2])))"
    )
    folder = __file__.rpartition("/")[0]
    done = subprocess.run(
        [sys.executable, "-c", code, folder, engine], capture_output=True, text=True, check=True
    )
    assert episode(task(engine)) in done.stdout.split()


class Scene:
    """A world of two given poses."""

    def __init__(self, held, lower):
        self.poses = held, lower

    def reset(self, joints, lower):
        """It stays as it was made."""

    def held(self):
        return self.poses[0]

    def lower(self):
        return self.poses[1]

    def image(self):
        return np.zeros((4, 4, 3), np.uint8)


def still(off=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0), lower_turn=(0.0, 0.0, 0.0), action_cost=0.0):
    """A brick ``off`` (m, in the lower one's axes) its seat."""
    axes = rotation(lower_turn)
    lower = Pose(np.array([0.6, 0.1, 0.0096]), axes)
    held = Pose(lower.position + axes @ np.add(off, (0, 0, facts.HEIGHT)), rotation(turn))
    stacking = Stacking(Scene(held, lower), 0.0, 0, action_cost)
    stacking.reset(np.random.default_rng(0))
    return stacking


def cost(stacking, action=(0.0, 0.0, 0.0, 0.0)):
    return stacking.step(np.array(action))[1]


def test_no_file_stays_behind(monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    make_world("pybullet").reset(np.array(facts.HOME), np.zeros(3))
    assert list(tmp_path.iterdir()) == []


def test_the_cost_is_that_of_appendix_d():
    assert cost(still()) == pytest.approx(0.0, abs=1e-12)
    # |3| + 2 |-4| + |12| cm, plus a tenth of the norm, 13 cm
    assert cost(still((0.03, -0.04, 0.12))) == pytest.approx(0.03 + 0.08 + 0.12 + 0.013)
    assert cost(still(turn=(0.0, 0.0, 0.2))) == pytest.approx(0.15 * 0.2)
    assert cost(still(turn=(0.3, 0.0, 0.0))) == pytest.approx(0.15 * 0.3)
    assert cost(still(turn=(0.0, 0.0, 0.2), lower_turn=(0.0, 0.0, -0.1))) == pytest.approx(0.045)
    assert cost(still(action_cost=0.5), (1.0, -1.0, 0.5, 0.0)) == pytest.approx(0.5 * 2.25)


def test_half_a_turn_fits_too():
    assert cost(still(turn=(0.0, 0.0, np.pi - 0.1))) == pytest.approx(0.15 * 0.1)
    assert still(turn=(0.0, 0.0, np.pi)).measures() == {"distance": 0.0, "stacked": 1.0}
    assert cost(still(turn=(np.pi, 0.0, 0.0))) == pytest.approx(0.15 * np.pi)


@pytest.mark.parametrize(
    ("off", "turn", "stacked"),
    [
        ((0, 0, 0.0014), (0, 0, 0), 1.0),
        ((0, 0, 0.0016), (0, 0, 0), 0.0),
        ((0, 0, -0.0016), (0, 0, 0), 0.0),
        ((0.0015, -0.0019, 0), (0, 0, 0), 1.0),
        ((0.0018, -0.0019, 0), (0, 0, 0), 0.0),
        ((0, 0, 0), (0, 0, -0.09), 1.0),
        ((0, 0, 0), (0, 0, 0.11), 0.0),
        ((0, 0, 0), (0.11, 0, 0), 0.0),
    ],
)
def test_stacked_means_seated(off, turn, stacked):
    measures = still(off, turn).measures()
    assert measures["stacked"] == stacked
    assert measures["distance"] == pytest.approx(100 * np.linalg.norm(off), abs=1e-9)


def test_the_seat_is_on_top_of_a_tipped_brick():
    tipped = still((0.001, 0.0, 0.0), turn=(0.2, 0.0, 0.4), lower_turn=(0.2, 0.0, 0.4))
    assert tipped.measures() == {"distance": pytest.approx(0.1), "stacked": 1.0}


def test_who_drags_the_lower_brick_along_gets_no_nearer_to_the_goal():
    stacking = still()
    world, along, turn = stacking._world, np.array([0.0, 0.02, 0.0]), rotation((0.0, 0.0, 0.3))
    world.poses = [Pose(pose.position + along, turn @ pose.rotation) for pose in world.poses]
    assert cost(stacking) == pytest.approx(2 * 0.02 + 0.1 * 0.02 + 0.15 * 0.3)
    assert stacking.measures() == {"distance": pytest.approx(0.0, abs=1e-9), "stacked": 1.0}


def test_each_episodes_goal_stays_where_its_lower_brick_was_put(engine):
    rows = task(engine, jitter=0.02)
    rows.reset(streams(2))
    put = rows.truth()[:, 4:]
    for _ in range(25):
        rows.step(script(rows.truth()))
    for _ in range(10):
        held = rows.truth()[:, :3]
        _, costs = rows.step(np.tile([0.0, 1.0, 0.0, 0.0], (2, 1)))
    assert (rows.truth()[:, 5] - put[:, 1] > 0.02).all()  # dragged along
    off = held - np.column_stack([put, np.full(2, 1.5 * facts.HEIGHT)])
    turned = costs - np.abs(off) @ [1.0, 2.0, 1.0] - 0.1 * np.linalg.norm(off, axis=1)
    assert ((turned > 0.0) & (turned < 0.15 * 0.1)).all()


def seen_at(point):
    """Row and column of a point, by a pinhole camera of 84 pixels."""
    eye, look = np.array(facts.EYE), np.array(facts.LOOK)
    ahead = (look - eye) / np.linalg.norm(look - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    ray = np.array([(point - eye) @ axis for axis in (up, right, ahead)])
    focal = SIDE / 2 / np.tan(np.radians(facts.FIELD_OF_VIEW / 2))
    return SIDE / 2 - 0.5 + focal * np.array([-ray[0], ray[1]]) / ray[2]


def middle(mask):
    return np.argwhere(mask).mean(axis=0)


def test_both_bricks_are_seen_where_they_are(engine):
    rows = task(engine)
    frames = rows.reset(streams(3)).astype(float)
    for (red, green, blue), truth in zip(frames, rows.truth(), strict=True):
        lower = middle((blue > 1.5 * red) & (blue > 100))
        assert lower == pytest.approx(seen_at([*truth[4:], facts.HEIGHT / 2 + 0.002]), abs=1.0)
        held = middle((red > 2 * blue) & (green > 1.5 * blue) & (red > 100))
        # A finger hides a part of it.
        assert held == pytest.approx(seen_at(truth[:3]), abs=2.5)


def test_both_engines_show_the_same_scene():
    one, two = (task(engine).reset(streams(2)).astype(float) for engine in ("pybullet", "mujoco"))
    assert np.abs(one - two).mean() < 8.0


def test_a_person_sees_the_frame_enlarged(engine):
    rows = task(engine)
    frames = rows.reset(streams(2))
    shown = picture(card(), frames, 3)
    assert shown.shape == (2, 3 * SIDE, 3 * SIDE, 3)
    assert shown[:, 1::3, 1::3] == pytest.approx(frames.transpose(0, 2, 3, 1), abs=1.0)


FAULTS = {
    "unknown parameter": ({"parameters": {"bakend": "mujoco"}}, ["bakend", "did you mean"]),
    "unknown engine": ({"parameters": {"backend": "bullet"}}, ["backend", "'bullet'", "pybullet"]),
    "no engine": ({"parameters": {"backend": ["mujoco"]}}, ["backend", "mujoco"]),
    "too much jitter": ({"parameters": {"jitter": 0.03}}, ["jitter", "0.02", "0.03"]),
    "jitter of no number": ({"parameters": {"jitter": True}}, ["jitter", "True"]),
    "half periods": ({"step_seconds": 0.05}, ["step_seconds", "0.02", "0.05"]),
    "action": ({"action": {"size": 3, "bound": 1.0}}, ["task.action", "size = 4"]),
    "bound": ({"action": {"size": 4, "bound": 2.0}}, ["task.action", "bound <= 1.0"]),
    "grey": ({"observation": {"kind": "image", "height": 84, "width": 84}}, ["channels = 3"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_card_that_does_not_fit_is_one_line_with_a_remedy(fault):
    changes, expected = FAULTS[fault]
    settings = type(card()).model_validate(card().model_dump() | changes)
    with pytest.raises(UsageError) as caught:
        build_task(settings)
    assert "\n" not in str(caught.value)
    assert all(part in str(caught.value) for part in expected)


def test_without_pybullet_the_way_out_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "solar_cli.envs.sawyer.pybullet_world", raising=False)
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(UsageError, match=r'pybullet.*3\.12.*task.parameters.backend="mujoco"'):
        build_task(card())


def test_an_engine_is_loaded_only_where_it_is_used():
    code = (
        "import sys, solar_cli.envs.sawyer, solar_cli.envs.sawyer.urdf\n"
        "print({'pybullet', 'mujoco', 'torch', 'scipy', 'gymnasium'} & set(sys.modules))"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "set()"
