import hashlib
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from drawing import lacking

from solar_cli.envs import build_task, picture
from solar_cli.envs.offscreen import load_mujoco
from solar_cli.envs.reacher import SUBSTEPS, Reacher
from solar_cli.errors import UsageError
from solar_cli.settings import TaskSettings

pytestmark = pytest.mark.skipif(bool(lacking()), reason=lacking() or "it can be drawn")

SETTINGS = {
    "simulator": "reacher",
    "horizon": 50,
    "step_seconds": 0.02,
    "action_cost": 1.0,
    "parameters": {"target": [-0.1, -0.1]},
    "observation": {"kind": "image", "height": 64, "width": 64, "channels": 3},
    "action": {"size": 2, "bound": 1.0},
    "exploration": {"std": 0.15},
}
GYMNASIUM = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "reacher.xml"
"""the model of Reacher-v5, which makes 2 steps of it for an action"""


def task(settings=SETTINGS):
    return build_task(TaskSettings.model_validate(settings))


def arm():
    return Reacher((-0.1, -0.1), action_cost=1.0, size=64)


def streams(count, seed=0):
    return [np.random.default_rng([seed, i]) for i in range(count)]


def rows(count, seed=0):
    """Arms in every position, moving."""
    return np.random.default_rng(seed).uniform([-3, -2.9, -5, -5], [3, 2.9, 5, 5], (count, 4))


def tips(states):
    """Elbow and tip by hand: links of 0.1 m and 0.11 m, the second turned by both angles."""
    shoulder, both = states[:, 0], states[:, 0] + states[:, 1]
    elbow = 0.1 * np.column_stack([np.cos(shoulder), np.sin(shoulder)])
    return elbow, elbow + 0.11 * np.column_stack([np.cos(both), np.sin(both)])


def both_motions(warm):
    """Ten episodes of our model and of Gymnasium's, (10, 50, 4) each, and whether the elbow is at
    its limit (10, 50).

    Gymnasium's has two joints more, of a target that stays where it is.
    """
    mujoco, ours = load_mujoco(), arm()
    model = mujoco.MjModel.from_xml_path(str(GYMNASIUM))
    if not warm:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    data, noise = mujoco.MjData(model), np.random.default_rng(0)
    mine, theirs, limited = np.empty((10, 50, 4)), np.empty((10, 50, 4)), np.empty((10, 50), bool)
    for i, stream in enumerate(streams(10)):
        row = ours.initial(stream)
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:2] = [*row[:2], -0.1, -0.1], row[2:]
        push = noise.uniform(-1, 1, 2)
        for t in range(50):
            action = np.clip(push + noise.normal(0, 0.5, 2), -1, 1)
            row = ours.dynamics(row[None], action[None])[0]
            data.ctrl[:] = action
            mujoco.mj_step(model, data, SUBSTEPS)
            mine[i, t], theirs[i, t] = row, np.concatenate([data.qpos[:2], data.qvel[:2]])
            limited[i, t] = data.nefc > 0
    return mine, theirs, limited


def test_motion_is_that_of_gymnasiums_reacher_to_the_last_bit():
    mine, theirs, limited = both_motions(warm=False)
    assert limited.sum() > 20
    assert np.array_equal(mine, theirs)


def test_only_at_the_elbows_limit_may_the_memory_of_gymnasiums_solver_show():
    mine, theirs, limited = both_motions(warm=True)
    free = ~limited.any(axis=1)
    assert 0 < free.sum() < 10
    assert np.array_equal(mine[free], theirs[free])
    assert np.abs(mine - theirs).max() < 1e-6


def test_positions_by_hand():
    states = rows(100)
    assert arm().truth(states) == pytest.approx(np.hstack(tips(states)), abs=1e-12)


def test_the_cost_is_that_of_the_state_before_and_of_the_action_as_executed():
    run = task()
    run.reset(streams(6))
    for action in np.random.default_rng(0).uniform(-1.5, 1.5, (20, 6, 2)):
        elbow_and_tip = run.truth()
        _, costs = run.step(action)
        distance = np.linalg.norm(elbow_and_tip[:, 2:] - [-0.1, -0.1], axis=1)
        paid = distance + np.sum(np.clip(action, -1, 1) ** 2, axis=1)
        assert costs == pytest.approx(paid, rel=1e-12)


def test_the_cost_by_hand():
    states, action = rows(50, seed=1), np.tile([0.5, -1.0], (50, 1))
    distance = np.linalg.norm(tips(states)[1] - [-0.1, -0.1], axis=1)
    assert arm().cost(states, action) == pytest.approx(distance + 1.25, abs=1e-12)
    assert arm().measures(states)["distance"] == pytest.approx(distance, abs=1e-12)


def test_an_arm_starts_almost_stretched_and_almost_at_rest():
    states = np.stack([arm().initial(stream) for stream in streams(500)])
    largest = np.abs(states).max(axis=0)
    assert (largest <= [0.1, 0.1, 0.005, 0.005]).all()
    assert (largest > [0.099, 0.099, 0.00495, 0.00495]).all()
    # Uniform numbers of a range r have the variance r^2 / 3; 500 of them know it to 4 %.
    assert states.var(axis=0) == pytest.approx(np.square([0.1, 0.1, 0.005, 0.005]) / 3, rel=0.15)


def test_an_arm_left_alone_pays_for_its_distance():
    run = task()
    run.reset(streams(20))
    paid = sum(run.step(np.zeros((20, 2)))[1] for _ in range(50))
    # Stretched out to the right; starts of +-0.1 rad average out to the second order.
    assert paid.mean() == pytest.approx(50 * np.hypot(0.21 + 0.1, 0.1), rel=0.01)


def test_an_episode_depends_neither_on_its_place_nor_on_the_process():
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import test_reacher\n"
        "print(test_reacher.episode_digests([2, 0, 1]))"
    )
    command = [sys.executable, "-c", program, str(Path(__file__).parent)]
    shown = subprocess.run(command, capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == str(episode_digests([0, 1, 2])[[2, 0, 1]])


def episode_digests(order):
    """SHA-256 of what three episodes show, run side by side in this order."""
    run, moves = task(), np.random.default_rng(0).uniform(-1, 1, (12, 3, 2))[:, order]
    shown = [run.reset([streams(3)[i] for i in order])]
    for move in moves:
        frames, costs = run.step(move)
        shown += [frames, costs, run.truth()]
    episodes = [b"".join(part[i].tobytes() for part in shown) for i in range(3)]
    return np.array([hashlib.sha256(episode).hexdigest() for episode in episodes])


def pixel(points):
    """Row and column of points (N, 2) that lie 0.01 m above ground, of a camera at 0.6 m whose
    view is 45 degrees wide. The middle of the picture is between four pixels."""
    scale = 32 / ((0.6 - 0.01) * np.tan(np.pi / 8))
    return 31.5 + scale * points[:, ::-1] * (-1, 1)


def clear_of(place, states, metres=0.04):
    """Those states whose arm stays clear of a place."""
    elbow, tip = tips(states)
    along = np.linspace(0, 1, 20)[:, None, None]
    arms = np.concatenate([along * elbow, elbow + along * (tip - elbow)])
    return states[np.linalg.norm(arms - place, axis=-1).min(axis=0) > metres]


def test_the_tip_is_seen_where_it_is():
    states = clear_of([-0.1, -0.1], rows(200))
    # Not where the arm is folded so far that its base hides the tip.
    states = states[np.abs(states[:, 1]) < 2.0]
    assert len(states) > 50
    frames = arm().draw(states, np.empty((len(states), 0))).astype(float)
    # Of all that is drawn the tip alone is more green than blue.
    ink = (frames[:, 1] - frames[:, 2]).clip(min=0)
    centres = np.column_stack([ink.sum(axis=2) @ np.arange(64), ink.sum(axis=1) @ np.arange(64)])
    centres /= ink.sum(axis=(1, 2))[:, None]
    # The link covers what of the tip is on its side, about half a pixel.
    assert np.abs(centres - pixel(tips(states)[1])).max() < 0.75


def test_the_target_is_seen_where_it_is():
    settings = SETTINGS | {"parameters": {"target": [0.083, 0.121]}}
    for place, run in (([-0.1, -0.1], task()), ([0.083, 0.121], task(settings))):
        frame = run.reset(streams(1))[0].astype(float)
        # The floor is grey, the target is red: what it lacks of green and blue.
        ink = (frame[0] - frame[1:].mean(axis=0)).clip(min=0)
        ink[28:36] = 0  # the arm
        centre = np.array([ink.sum(axis=1) @ np.arange(64), ink.sum(axis=0) @ np.arange(64)])
        assert centre / ink.sum() == pytest.approx(pixel(np.array([place]))[0], abs=0.15)


def test_people_see_the_same_larger():
    settings = TaskSettings.model_validate(SETTINGS)
    frames = task().reset(streams(2))
    image = picture(settings, frames, 3)
    assert (image.shape, image.dtype) == ((2, 192, 192, 3), np.uint8)
    assert np.array_equal(image[:, 1::3, 1::3], frames.transpose(0, 2, 3, 1))


def test_nothing_is_said_when_python_ends_with_a_task_in_use():
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import test_reacher\n"
        "run = test_reacher.task(); run.reset(test_reacher.streams(2))"
    )
    command = [sys.executable, "-W", "error", "-c", program, str(Path(__file__).parent)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_a_package_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(UsageError, match="pip install mujoco"):
        task()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": {"traget": [0.0, 0.1]}}, "did you mean 'target'"),
        ({"parameters": {"target": "left"}}, "expected \\[x, y\\]"),
        ({"parameters": {"target": [0.2, 0.1]}}, "within 0.21 m"),
        ({"parameters": {"target": [True, 0.0]}}, "expected \\[x, y\\]"),
        ({"action": {"size": 3, "bound": 1.0}}, "size = 2"),
        ({"action": {"size": 2, "bound": 2.0}}, "bound = 1.0"),
        ({"step_seconds": 1.0}, "0.02 s"),
        ({"observation": {"kind": "state", "width": 4}}, "square images"),
        ({"observation": SETTINGS["observation"] | {"channels": 1}}, "channels = 3"),
        ({"observation": SETTINGS["observation"] | {"height": 32}}, "height = width"),
    ],
)
def test_a_setting_that_does_not_fit_is_named(change, message):
    with pytest.raises(UsageError, match=message) as caught:
        task(SETTINGS | change)
    assert "\n" not in str(caught.value)
