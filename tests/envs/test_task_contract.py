"""What every task promises to the methods, checked on every card."""

import subprocess
import sys

import numpy as np
import pytest
from drawing import lacking, mujoco_draws, skip_if_it_cannot_be_drawn

from solar_cli.envs import build_task, drawable, picture
from solar_cli.envs.task import RowTask
from solar_cli.settings import card_names, load_card


def streams(count, seed=0):
    return [np.random.default_rng([seed, i]) for i in range(count)]


def actions(settings, count, steps):
    """Well within the bounds to well beyond them."""
    scale = 1.5 * settings.action.bound
    return np.random.default_rng(1).uniform(-scale, scale, (steps, count, settings.action.size))


def run(task, starts, moves):
    """All that a task shows along an episode."""
    shown = [(task.reset(starts), None, task.measures(), task.truth())]
    shown += [(*task.step(move), task.measures(), task.truth()) for move in moves]
    return shown


def same(one, two, rows=slice(None)):
    for (f1, c1, m1, t1), (f2, c2, m2, t2) in zip(one, two, strict=True):
        assert np.array_equal(f1, f2[rows])
        assert (c1 is None and c2 is None) or np.array_equal(c1, c2[rows])
        assert all(np.array_equal(m1[name], m2[name][rows]) for name in m1 | m2)
        assert np.array_equal(t1, t2[rows])


@pytest.fixture(params=card_names())
def settings(request):
    settings = load_card(request.param).task
    if request.param == "sawyer":
        pytest.importorskip("pybullet")
    skip_if_it_cannot_be_drawn(settings)
    return settings


def test_there_are_tasks():
    assert {"nav", "nav-fixed", "car", "car-states", "reacher", "sawyer"} <= set(card_names())


def test_shapes_types_and_finite_numbers(settings):
    task = build_task(settings)
    assert (task.horizon, task.action_size) == (settings.horizon, settings.action.size)
    for frames, costs, measures, truth in run(task, streams(7), actions(settings, 7, 10)):
        assert frames.shape == (7, *settings.observation.frame_shape)
        assert frames.dtype == (np.uint8 if settings.observation.kind == "image" else np.float32)
        assert np.isfinite(frames).all()
        assert costs is None or (costs.shape, costs.dtype) == ((7,), np.float64)
        assert costs is None or np.isfinite(costs).all()
        assert all(value.shape == (7,) and np.isfinite(value).all() for value in measures.values())
        assert truth.shape == (7, len(task.truth_names))
        assert np.isfinite(truth).all()


def test_the_same_streams_and_actions_give_the_same_bits(settings):
    moves = actions(settings, 6, 12)
    one, two = (run(build_task(settings), streams(6), moves) for _ in range(2))
    same(one, two)
    other = run(build_task(settings), streams(6, seed=1), moves)
    assert not np.array_equal(one[0][3], other[0][3])


def test_an_episode_does_not_depend_on_those_beside_it(settings):
    """Sums over a batch differ by its size; simulators that run one by one have no such sums."""
    batched = isinstance(build_task(settings), RowTask)
    count, some = (33, (1, 2, 3, 7, 8, 9, 17)) if batched else (3, (1, 2))
    moves = actions(settings, count, 12)
    all_of_them = run(build_task(settings), streams(count), moves)
    for few in some:
        those = run(build_task(settings), streams(count)[:few], moves[:, :few])
        same(those, all_of_them, slice(0, few))


def test_a_reset_forgets_what_was_before(settings):
    moves = actions(settings, 4, 5)
    task = build_task(settings)
    run(task, streams(9, seed=3), actions(settings, 9, 5))
    same(run(task, streams(4), moves), run(build_task(settings), streams(4), moves))


def test_nothing_handed_out_is_used_again(settings):
    moves = actions(settings, 4, 5)
    expected = run(build_task(settings), streams(4), moves)
    task = build_task(settings)
    seen, spoilt = [], []
    for step in range(6):
        frames, costs = (task.reset(streams(4)), None) if step == 0 else task.step(moves[step - 1])
        given = [frames, costs, *task.measures().values(), task.truth()]
        arrays = [array for array in given if array is not None]
        assert not any(np.shares_memory(old, new) for old in spoilt for new in arrays)
        seen.append((frames.copy(), costs, dict(task.measures()), task.truth()))
        for array in arrays:
            array.fill(77)
        spoilt += arrays
    for (frames, _, _, truth), (wanted, _, _, wanted_truth) in zip(seen, expected, strict=True):
        assert np.array_equal(frames, wanted)
        assert np.array_equal(truth, wanted_truth)


def test_actions_given_are_left_as_they_are(settings):
    task = build_task(settings)
    task.reset(streams(3))
    given = actions(settings, 3, 1)[0]
    before = given.copy()
    task.step(given)
    assert np.array_equal(given, before)


def test_actions_beyond_the_bounds_are_clipped(settings):
    bound = settings.action.bound
    far = np.full((3, settings.action.size), 10.0 * bound)
    one = run(build_task(settings), streams(3), [far])
    two = run(build_task(settings), streams(3), [np.full_like(far, bound)])
    same(one, two)


def test_actions_of_another_shape_are_refused(settings):
    task = build_task(settings)
    with pytest.raises(ValueError, match="reset first"):
        task.step(np.zeros((3, settings.action.size)))
    task.reset(streams(3))
    with pytest.raises(ValueError, match="one action for each episode"):
        task.step(np.zeros((1, settings.action.size)))


def test_rows_that_start_anew_leave_the_others_alone(settings):
    moves = actions(settings, 4, 6)
    whole = run(build_task(settings), streams(4), moves)
    task = build_task(settings)
    task.reset(streams(4))
    for move in moves[:3]:
        task.step(move)
    which = np.array([0, 2])
    restarted = task.restart(which, streams(2, seed=8))
    fresh = build_task(settings)
    assert np.array_equal(restarted, fresh.reset(streams(2, seed=8)))
    for step, move in enumerate(moves[3:], start=4):
        frames, costs = task.step(move)
        fresh_frames, fresh_costs = fresh.step(move[which])
        assert np.array_equal(frames[which], fresh_frames)
        assert np.array_equal(costs[which], fresh_costs)
        assert np.array_equal(frames[[1, 3]], whole[step][0][[1, 3]])


def test_what_is_drawn_of_a_task_is_that_task(settings):
    if mujoco_draws(settings) and lacking():
        pytest.skip(lacking())
    drawn = drawable(settings, 36)
    moves = actions(settings, 2, 3)
    one, two = (run(build_task(which), streams(2), moves) for which in (settings, drawn))
    for (_, c1, m1, t1), (frames, c2, m2, t2) in zip(one, two, strict=True):
        assert frames.shape == (2, *drawn.observation.frame_shape)
        assert picture(drawn, frames, 2).shape == (2, *(2 * s for s in frames.shape[2:]), 3)
        assert (c1 is None and c2 is None) or np.array_equal(c1, c2)
        assert all(np.array_equal(m1[name], m2[name]) for name in m1 | m2)
        assert np.array_equal(t1, t2)
    assert (drawn is settings) == (settings.observation.kind == "image")


def test_simulators_need_no_heavy_package():
    code = (
        "import sys, solar_cli.envs.car, solar_cli.envs.navigation, solar_cli.envs.reacher\n"
        "heavy = {'torch', 'scipy', 'gymnasium', 'matplotlib', 'pandas', 'mujoco'}\n"
        "print(heavy & set(sys.modules))"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "set()"
