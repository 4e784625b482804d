"""Checks of a task against regressions in NumPy, delayed systems, and the car at its wall."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

from solar_cli.control import task_checks
from solar_cli.control.exploration import smooth_noise
from solar_cli.control.task_checks import is_stuck, last_action, task_metrics
from solar_cli.control.trajectories import Trajectories
from solar_cli.envs.car import STEERING, TARGET, WALL, Car
from solar_cli.models.basis import LatentBasis

ACTION_COST = 0.001
FREE = math.inf
"""bound of actions that nothing clips"""


def trajectories(z, actions, means=None, costs=None, lengths=None) -> Trajectories:
    means = np.zeros_like(actions) if means is None else means
    costs = np.zeros(actions.shape[:2]) if costs is None else costs
    episodes, horizon = actions.shape[:2]
    lengths = np.full(episodes, horizon) if lengths is None else lengths
    live = np.arange(horizon) < lengths[:, None]
    return Trajectories(*map(torch.as_tensor, (z, actions, means, costs, live)))


def states(latents, window):
    """Whitened windows of latents (N, T+1, d), newest first, as a representation makes them."""
    times = np.maximum(np.arange(latents.shape[1])[:, None] - np.arange(window), 0)
    windows = torch.as_tensor(latents[:, times])
    return LatentBasis.whitening(windows.flatten(0, 1)).state(windows).numpy()


def moved_by(actions, delay, noise, rng):
    """Positions that the action ``delay`` steps before the last one moves, seen with noise."""
    episodes, horizon, size = actions.shape
    late = np.concatenate([np.zeros((episodes, delay, size)), actions], axis=1)[:, :horizon]
    start = rng.normal(size=(episodes, 1, size))
    places = np.concatenate([start, start + late.cumsum(axis=1)], axis=1)
    return places + noise * rng.normal(size=places.shape)


# The last action


@pytest.mark.parametrize("bound", [FREE, 2.0])
@pytest.mark.parametrize(("d", "a"), [(1, 2), (2, 1)])
def test_the_p_value_is_that_of_nested_regressions(d, a, bound):
    """With a dummy for each time step of each batch; of episodes that end early, live steps.

    Without those that one of the last four actions led to at its bound.
    """
    rng = np.random.default_rng(0)
    batches, rows = [], []
    for number in range(2):
        lengths = np.array([7, 4, 7, 2, 6, 7, 5, 7, 3])
        z, actions = rng.normal(size=(9, 8, 3)), rng.normal(size=(9, 7, a)).clip(-bound, bound)
        means = rng.normal(size=actions.shape)
        z[:, 1:, :d] += 0.4 * (actions - means)[..., :1]
        batches.append(trajectories(z, actions, means, lengths=lengths))
        for n, t in np.argwhere(np.arange(7) < lengths[:, None]):
            if np.abs(actions[n, max(t - 3, 0) : t + 1]).max() == bound:
                continue
            noise = [(actions - means)[n, t - k] if t >= k else np.zeros(a) for k in range(4)]
            step = np.eye(14)[7 * number + t]
            rows.append((z[n, t + 1, :d] - z[n, t, :d], noise[0], [*z[n, t], *step, *noise[1:]]))
    y, last = (np.array([row[k] for row in rows]) for k in (0, 1))
    others = np.array([np.hstack(row[2]) for row in rows])

    def errors(design):
        residual = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
        return residual.T @ residual

    whole = np.hstack([others, last])
    fewer, more, free = errors(others), errors(whole), len(y) - np.linalg.matrix_rank(whole)
    wilks = np.linalg.det(more) / np.linalg.det(fewer)  # exact where d or a is 1
    expected = stats.f.sf((1 / wilks - 1) * (free - d + 1) / (d * a), d * a, free - d + 1)
    assert 1e-20 < expected < 0.5
    assert last_action(batches, d, bound)[0] == pytest.approx(expected, rel=1e-5)


def test_without_an_effect_p_values_are_uniform():
    rng = np.random.default_rng(1)
    found = []
    for _ in range(300):
        z, actions = rng.normal(size=(6, 13, 4)), rng.normal(size=(6, 12, 2))
        p_value, late = last_action([trajectories(z, actions)], 2, FREE)
        found.append(p_value)
        assert not late
    assert stats.kstest(found, "uniform").pvalue > 0.01


@pytest.mark.parametrize("noise", [0.0, 1.0, 5.0])
@pytest.mark.parametrize("delay", [0, 1, 2])
def test_an_action_that_is_seen_late_is_found_however_noisy_latents_are(delay, noise):
    """At a noise of 5 an action explains 2 % of the increments' variance."""
    rng = np.random.default_rng(2)
    actions = rng.normal(size=(200, 50, 2))
    z = states(moved_by(actions, delay, noise, rng), 1)
    p_value, late = last_action([trajectories(z, actions)], 2, FREE)
    assert late == (delay > 0)
    assert (p_value < 1e-9) == (delay == 0)


def held_in_place(delay, bound, rng, episodes=100, horizon=50):
    """Positions that feedback holds at zero, in episodes whose actions are clipped."""
    places, late = 1.5 * rng.normal(size=(episodes, 2)), np.zeros((delay + 1, episodes, 2))
    seen, actions, means = [], [], []
    for _ in range(horizon):
        seen.append(places + 0.1 * rng.normal(size=places.shape))
        means.append(-seen[-1])
        actions.append((means[-1] + 0.7 * rng.normal(size=places.shape)).clip(-bound, bound))
        late = np.concatenate([actions[-1:], late[:-1]])
        places = places + 0.3 * late[-1]
    seen.append(places + 0.1 * rng.normal(size=places.shape))
    return trajectories(*(np.stack(part, axis=1) for part in (seen, actions, means)))


def test_actions_that_are_clipped_hide_no_delay():
    """What is left of the noise of a clipped action tells where the state was, not what it did."""
    for seed in range(5):
        shown, late = (held_in_place(k, 1.0, np.random.default_rng(seed)) for k in (0, 1))
        assert 0.2 < float((late.actions.abs() == 1.0).double().mean()) < 0.25
        assert last_action([late], 2, 1.0)[1]
        p_value, found = last_action([shown], 2, 1.0)
        assert p_value < 1e-9
        assert not found


def test_where_nearly_all_actions_are_clipped_nothing_is_said():
    held = held_in_place(1, 0.01, np.random.default_rng(0))
    assert last_action([held], 2, 0.01) == (1.0, False)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.2])
def test_a_hidden_velocity_does_not_make_an_action_late(noise):
    """The noisier positions are, the more all earlier actions tell of the velocity."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        actions = rng.normal(size=(100, 50, 2))
        velocity = 0.1 * actions.cumsum(axis=1)
        z = states(moved_by(0.1 * velocity, 0, noise, rng), 4)
        assert not last_action([trajectories(z, actions)], 2, FREE)[1]


def test_noise_that_is_smooth_in_time_does_not_make_an_action_late():
    """The oldest action that is told apart answers for all before it, which are much like it."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        actions = smooth_noise((200, 50, 2), 2.0, rng)
        velocity = 0.1 * actions.cumsum(axis=1)
        z = states(moved_by(0.1 * velocity, 0, 0.1, rng), 4)
        assert not last_action([trajectories(z, actions)], 2, FREE)[1]


class ExplicitCar(Car):
    """The car with explicit Euler: where it goes next is decided before the action."""

    def dynamics(self, rows, actions):
        moved = super().dynamics(rows, np.zeros_like(actions))
        pushed = super().dynamics(rows, actions)
        return np.concatenate([moved[:, :3], pushed[:, 3:]], axis=1)


@pytest.mark.parametrize(("car", "expected"), [(Car, False), (ExplicitCar, True)])
def test_a_car_by_explicit_euler_shows_its_actions_late(car, expected):
    rng, simulator = np.random.default_rng(3), car(ACTION_COST)
    actions = 3.0 * rng.normal(size=(40, 100, 2))
    rows = np.stack([simulator.initial(rng) for _ in range(40)])
    truth = [simulator.truth(rows)]
    for t in range(100):
        rows = simulator.dynamics(rows, actions[:, t])
        truth.append(simulator.truth(rows))
    seen = np.stack(truth, axis=1)
    z = states(seen + 0.01 * rng.normal(size=seen.shape), 4)
    assert last_action([trajectories(z, actions)], 4, FREE)[1] == expected


def test_older_batches_and_only_episodes_with_noise_tell():
    rng = np.random.default_rng(4)
    actions = rng.normal(size=(60, 20, 2))
    z = states(moved_by(actions, 1, 1.0, rng), 1)
    newest, older = (trajectories(z[rows], actions[rows]) for rows in (slice(10), slice(10, 60)))
    quiet = trajectories(z[10:], actions[10:], actions[10:])
    assert not last_action([newest], 2, FREE)[1]
    assert last_action([newest, older], 2, FREE)[1]
    assert last_action([newest, quiet], 2, FREE) == last_action([newest], 2, FREE)
    assert last_action([quiet], 2, FREE) == (1.0, False)


def test_latents_that_do_not_move_or_are_far_out_are_no_reason_to_stop():
    rng = np.random.default_rng(5)
    actions = rng.normal(size=(20, 20, 2))
    for scale in (0.0, 1e-12, 1e12):
        z = scale * moved_by(actions, 0, 0.1, rng) @ np.ones((2, 3))  # of rank 1, too
        assert np.isfinite(last_action([trajectories(z, actions)], 3, FREE)[0])


def test_some_of_very_many_transitions_are_enough(monkeypatch):
    rng = np.random.default_rng(9)
    actions = rng.normal(size=(200, 50, 2))
    for delay in (0, 1):
        batch = trajectories(states(moved_by(actions, delay, 1.0, rng), 1), actions)
        whole = last_action([batch], 2, FREE)
        monkeypatch.setattr(task_checks, "JUDGED", 3000)  # of 10000
        some = last_action([batch], 2, FREE)
        monkeypatch.undo()
        assert (whole[1], some[1]) == (delay == 1, delay == 1)
        assert delay == 0 or some[0] != whole[0]  # p is zero without a delay
    # Without an effect, p values stay uniform.
    monkeypatch.setattr(task_checks, "JUDGED", 30)
    found = [
        last_action(
            [trajectories(rng.normal(size=(8, 13, 2)), rng.normal(size=(8, 12, 1)))], 1, FREE
        )[0]
        for _ in range(300)
    ]
    assert stats.kstest(found, "uniform").pvalue > 0.01


# Stuck


def drive(stop, std, horizon=60, episodes=20, seed=6):
    """The car on its way past the target from the right, on a line: it brakes at x = ``stop``."""
    rng, simulator = np.random.default_rng(seed), Car(ACTION_COST)
    rows = np.tile([0.5, TARGET[1], np.pi, 0.0, 0.0], (episodes, 1))
    rows[:, :2] += 0.05 * rng.normal(size=(episodes, 2))
    truth, actions, means, costs = [simulator.truth(rows)], [], [], []
    for _ in range(horizon):
        x, y, heading, speed, steering = rows.T
        wanted = np.clip(1.5 * (x - stop), -1.0, 1.0)
        turn = np.clip((y - TARGET[1]) - 1.5 * (heading - np.pi), -STEERING, STEERING)
        means.append(np.stack([4.0 * (wanted - speed), 6.0 * (turn - steering)], axis=1))
        actions.append(means[-1] + std * rng.normal(size=means[-1].shape))
        costs.append(simulator.cost(rows, actions[-1]))
        rows = simulator.dynamics(rows, actions[-1])
        truth.append(simulator.truth(rows))
    z, *rest = (np.stack(part, axis=1) for part in (truth, actions, means, costs))
    return trajectories(states(z, 4), *rest), rows


NEVER = -10.0


@pytest.mark.parametrize("std", [1.0, 2.0])
def test_a_car_at_the_wall_behind_its_target_is_stuck_and_one_that_stops_is_not(std):
    at_wall, rows = drive(NEVER, std)
    np.testing.assert_array_equal(rows[:, 0], -WALL)
    assert is_stuck(at_wall, 4, ACTION_COST)
    for stop in (TARGET[0] + 0.5, TARGET[0], TARGET[0] - 0.1):
        stopped, rows = drive(stop, std)
        assert np.abs(rows[:, 0] - stop).max() < 0.4
        assert not is_stuck(stopped, 4, ACTION_COST)


def test_metrics_are_those_of_the_newest_batch_and_of_all():
    at_wall, stopped = drive(NEVER, 1.0)[0], drive(TARGET[0], 1.0)[0]
    found = task_metrics(at_wall, [stopped], 4, ACTION_COST, 3.0)
    assert found["last_action_p_value"] == last_action([at_wall, stopped], 4, 3.0)[0]
    assert (found["action_seen_late"], found["stuck"]) == (0.0, 1.0)
    assert task_metrics(stopped, [at_wall], 4, ACTION_COST, 3.0)["stuck"] == 0.0


def test_without_noise_or_before_the_end_nobody_knows():
    at_wall, _ = drive(NEVER, 1.0)
    assert not is_stuck(at_wall._replace(action_means=at_wall.actions), 4, ACTION_COST)
    assert not is_stuck(at_wall.only(torch.arange(20) < 4), 4, ACTION_COST)
    for steps in (25, 4):  # on its way
        assert not is_stuck(at_wall.until(steps), 4, ACTION_COST)
    ended = at_wall.live.clone()
    ended[:, -1] = False
    assert not is_stuck(at_wall._replace(live=ended), 4, ACTION_COST)


def line(places, target, actions=None, rest=0.0):
    """Latents on a line (N, T+1), which cost their distance to ``target``, squared."""
    rng = np.random.default_rng(7)
    actions = rng.normal(size=(*places[:, 1:].shape, 1)) if actions is None else actions
    costs = np.square(places[:, :-1] - target) + rest
    return trajectories(places[..., None], actions, costs=costs)


@pytest.mark.parametrize(
    ("wall", "target", "stuck"),
    [
        (1.2, 1.0, True),  # it passed the target
        (1.2, 1.2, False),  # there it is
        (1.2, 2.0, False),  # held, but nothing has been better
        (9.0, 1.0, False),  # it moves on
    ],
)
def test_latents_at_a_bound_are_stuck_where_it_has_been_better(wall, target, stuck):
    steps = 0.1 + 0.03 * np.random.default_rng(8).normal(size=(12, 40))
    places = np.minimum(np.hstack([np.zeros((12, 1)), steps]).cumsum(axis=1), wall)
    assert is_stuck(line(places, target), 1, 0.0) == stuck
    assert is_stuck(line(places, target, rest=-50.0), 1, 0.0) == stuck  # whatever zero is


@pytest.mark.parametrize(("wall", "stuck"), [(1.05, True), (1.02, False)])
def test_what_is_held_next_to_the_best_is_not_stuck(wall, stuck):
    """A thousandth of the span of costs is 3 % of the way."""
    steps = 0.01 + 0.001 * np.random.default_rng(8).normal(size=(12, 150))
    places = np.minimum(np.hstack([np.zeros((12, 1)), steps]).cumsum(axis=1), wall)
    assert is_stuck(line(places, 1.0), 1, 0.0) == stuck


def test_what_an_action_costs_does_not_make_a_rest_dear():
    steps = 0.1 + 0.03 * np.random.default_rng(8).normal(size=(12, 40))
    places = np.minimum(np.hstack([np.zeros((12, 1)), steps]).cumsum(axis=1), 1.0)
    actions = np.ones((12, 40, 1))
    actions[:, -20:] = 3.0
    batch = line(places, 1.0, actions)
    dear = batch._replace(costs=batch.costs + 0.5 * batch.actions.square().sum(dim=-1))
    assert is_stuck(dear, 1, 0.0)
    assert not is_stuck(dear, 1, 0.5)
