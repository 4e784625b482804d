"""The arm's kinematics and control against both engines, differences and a published pose."""

import numpy as np
import pytest
from sawyer_worlds import make_world
from scipy.spatial.transform import Rotation

from solar_cli.envs.sawyer import facts
from solar_cli.envs.sawyer.control import (
    LEASH,
    LOWER,
    PERIOD,
    SPEED,
    UPPER,
    VelocityControl,
    angles,
    kinematics,
    rotation,
)

NEUTRAL = np.array([0.0, -1.18, 0.0, 2.18, 0.0, 0.57, 3.3161])
START = np.array([0.62, 0.02, 0.15])
FAR_AWAY = np.array([1.2, 1.2, 0.0])


def postures(count):
    return np.random.default_rng(0).uniform(LOWER, UPPER, (count, 7))


def test_the_neutral_pose_is_where_others_have_it():
    """The hand of robosuite's Sawyer is at this place in its neutral pose, and points down."""
    pose, _ = kinematics(NEUTRAL)
    hand = pose.position + 0.145 * pose.rotation[:, 2]
    assert hand == pytest.approx([0.44959778, 0.1603, 0.21575405], abs=2e-8)
    assert pose.rotation[2, 2] == pytest.approx(1.0, abs=1e-3)


def test_both_engines_have_the_arm_where_the_kinematics_say(engine):
    world = make_world(engine)
    for joints in postures(20):
        world.reset(joints, FAR_AWAY)
        expected, _ = kinematics(joints)
        held = world.held()
        assert world.joints() == pytest.approx(joints, abs=1e-12)
        assert held.position == pytest.approx(expected.position, abs=1e-6)
        assert held.rotation == pytest.approx(expected.rotation, abs=1e-6)


def test_both_engines_feel_the_same_arm():
    """Mass matrices: every mass, centre, inertia and axis counts in them."""
    bullet, mujoco = make_world("pybullet"), make_world("mujoco")
    for joints in postures(5):
        for world in (bullet, mujoco):
            world.reset(joints, FAR_AWAY)
        one = pybullet_mass_matrix(bullet, joints)
        two = mujoco_mass_matrix(mujoco) - 0.1 * np.eye(7)  # rotors, which PyBullet knows not
        assert one == pytest.approx(two, abs=1e-6)


def pybullet_mass_matrix(world, joints):
    import pybullet

    return np.array(pybullet.calculateMassMatrix(world._arm, joints.tolist(), **world._client))


def mujoco_mass_matrix(world):
    import mujoco

    whole = np.zeros((world._model.nv, world._model.nv))
    mujoco.mj_fullM(world._model, world._data, whole)
    return whole[:7, :7]


def test_rotations_turn_about_fixed_axes():
    for turn in np.random.default_rng(1).uniform(-3, 3, (5, 3)):
        expected = Rotation.from_euler("xyz", turn).as_matrix()
        assert rotation(tuple(turn)) == pytest.approx(expected, abs=1e-12)


def test_the_jacobian_is_the_derivative_of_the_pose():
    step = 1e-6
    for joints in postures(5):
        pose, jacobian = kinematics(joints)
        for column, unit in zip(jacobian.T, np.eye(7), strict=True):
            ahead, behind = kinematics(joints + step * unit)[0], kinematics(joints - step * unit)[0]
            velocity = (ahead.position - behind.position) / (2 * step)
            spin = (ahead.rotation - behind.rotation) / (2 * step) @ pose.rotation.T
            assert column[:3] == pytest.approx(velocity, abs=1e-8)
            assert column[3:] == pytest.approx([spin[2, 1], spin[0, 2], spin[1, 0]], abs=1e-8)


def test_the_arm_takes_a_place_upright():
    rng = np.random.default_rng(2)
    for _ in range(10):
        place, yaw = START + rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.6, 0.6)
        joints = angles(place, yaw)
        pose, _ = kinematics(joints)
        assert pose.position == pytest.approx(place, abs=1e-9)
        assert pose.rotation == pytest.approx(rotation((0.0, 0.0, yaw)), abs=1e-9)
        assert ((joints > LOWER) & (joints < UPPER)).all()


def test_a_place_out_of_reach_is_refused():
    with pytest.raises(ValueError, match="cannot hold"):
        angles(np.array([2.0, 0.0, 0.1]), 0.0)


def drive(world, control, action, seconds):
    for _ in range(round(seconds / PERIOD)):
        world.advance(control.targets(np.array(action), world.joints()))


@pytest.mark.parametrize("action", [(1, 0, 0, 0), (0, -1, 0, 0), (0, 0, 0.5, 0), (0, 0, 0, -1)])
def test_an_action_is_a_velocity(engine, action):
    """Within 4 %: a servo of a lag of 25 ms is 2.5 % of a second behind."""
    world, start = make_world(engine), angles(START, 0.1)
    world.reset(start, FAR_AWAY)
    control = VelocityControl(start)
    drive(world, control, action, 1.0)
    held = world.held()
    yaw = np.arctan2(held.rotation[1, 0], held.rotation[0, 0])
    moved = np.array([*(held.position - START), yaw - 0.1])
    expected = np.array([0.1, 0.1, 0.1, 0.5]) * action
    assert moved == pytest.approx(expected, abs=0.04 * np.abs(expected).max())
    assert held.rotation[2, 2] > 0.99999
    assert held.position == pytest.approx(kinematics(world.joints())[0].position, abs=1e-6)
    drive(world, control, (0, 0, 0, 0), 0.5)
    rest = world.held().position
    drive(world, control, (0, 0, 0, 0), 1.0)
    assert world.held().position == pytest.approx(rest, abs=1e-5)


def test_an_arm_that_is_blocked_does_not_wind_up(engine):
    """Two seconds of pressing on the table are undone in a fraction of one."""
    world, start = make_world(engine), angles(np.array([0.7, 0.1, 0.02]), 0.0)
    world.reset(start, FAR_AWAY)
    control = VelocityControl(start)
    drive(world, control, (0, 0, -1, 0), 2.0)
    pressed = world.held().position
    assert pressed == pytest.approx([0.7, 0.1, facts.HEIGHT / 2], abs=1.5e-3)
    drive(world, control, (0, 0, 1, 0), 0.2)
    assert world.held().position[2] > pressed[2] + 0.008


def test_a_blocked_arm_has_its_targets_on_a_leash():
    joints = angles(START, 0.0)
    _, jacobian = kinematics(joints)
    step = PERIOD * np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.5])
    for action in np.random.default_rng(3).uniform(-1, 1, (4, 4)):
        control = VelocityControl(joints)
        for _ in range(200):
            targets = control.targets(action, joints)
        assert (np.abs(jacobian @ (targets - joints)) < 1.05 * (LEASH + step)).all()


def test_joints_keep_to_their_speeds_and_limits():
    slowed = 0
    for action in np.array([(1, 0, 1, 0), (-1, -1, 0, 0)]):
        joints = angles(START, 0.0)
        control = VelocityControl(joints)
        for _ in range(600):  # an arm that follows at once, to the end of its reach
            targets = control.targets(action, joints)
            speeds = np.abs(targets - joints) / PERIOD
            assert (speeds <= SPEED * (1 + 1e-9)).all()
            assert ((targets >= LOWER) & (targets <= UPPER)).all()
            slowed += (speeds / SPEED).max() > 0.999
            joints = targets
    assert slowed


def test_a_tilted_hand_rights_itself():
    joints = angles(START, 0.0) + np.array([0, 0, 0, 0, 0.1, 0.1, 0])
    control = VelocityControl(joints)
    tilts = []
    for _ in range(100):
        up = kinematics(joints)[0].rotation[:, 2]
        tilts.append(np.hypot(up[0], up[1]))
        joints = control.targets(np.zeros(4), joints)
    # It loses the same share in every period: 2 per second.
    assert tilts[-1] == pytest.approx(tilts[0] * (1 - 2.0 * PERIOD) ** 99, rel=0.05)
