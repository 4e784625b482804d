"""Neural models: what of an episode they see, what they predict, and how that is judged."""

import numpy as np
import pytest
import torch
from model_problems import vector_episodes, vector_task

from solar_cli.episodes import Episodes
from solar_cli.models.basis import LatentBasis
from solar_cli.models.neural import (
    NeuralCost,
    NeuralDynamics,
    Sequences,
    Standardised,
    cost_r2,
    explained,
    prediction_r2,
)
from solar_cli.models.neural_fit import NeuralModel
from solar_cli.settings.neural import NeuralFit

LINEAR = NeuralFit(widths=())
T, z, a = 6, 3, 2


def made_up(count=4, lengths=(6, 3, 1, 6), seed=0) -> Sequences:
    rng = np.random.default_rng(seed)
    live = np.arange(T) < np.array(lengths)[:, None]
    return Sequences(
        torch.from_numpy(rng.normal(size=(count, T + 1, z))).float(),
        torch.from_numpy(rng.normal(size=(count, T, a))).float(),
        torch.from_numpy(rng.normal(size=(count, T))).float(),
        torch.from_numpy(live),
    )


class Linear:
    """s' = s + A s + B u, as a `NeuralDynamics` without hidden layers."""

    A = np.random.default_rng(1).normal(0, 0.2, (z, z))
    B = np.random.default_rng(2).normal(0, 0.5, (z, a))

    @classmethod
    def model(cls) -> NeuralDynamics:
        dynamics = NeuralDynamics(z, z, a, LINEAR)
        layer = dynamics.change.body[-1]
        with torch.no_grad():
            layer.weight.copy_(torch.from_numpy(np.hstack([cls.A, cls.B])))
            layer.bias.zero_()
        return dynamics

    @classmethod
    def episodes(cls, count=5, seed=3) -> Sequences:
        rng = np.random.default_rng(seed)
        actions = rng.normal(size=(count, T, a))
        states = rng.normal(size=(count, T + 1, z))
        for t in range(T):
            states[:, t + 1] = states[:, t] + states[:, t] @ cls.A.T + actions[:, t] @ cls.B.T
        return Sequences(
            torch.from_numpy(states).float(),
            torch.from_numpy(actions).float(),
            torch.zeros(count, T),
            torch.ones(count, T, dtype=torch.bool),
        )


# What is seen


@pytest.mark.parametrize("steps", [1, 2, 5, 6])
def test_segments_are_all_runs_of_live_steps(steps):
    seen = made_up()
    expected = [
        (n, t)
        for n in range(4)
        for t in range(T - steps + 1)
        if bool(seen.live[n, t : t + steps].all())
    ]
    episode, step = seen.starts(steps)
    assert list(zip(episode.tolist(), step.tolist(), strict=True)) == expected
    segment = seen.segments(episode, step, steps)
    for i, (n, t) in enumerate(expected):
        np.testing.assert_array_equal(segment.states[i], seen.states[n, t : t + steps + 1])
        np.testing.assert_array_equal(segment.actions[i], seen.actions[n, t : t + steps])
        np.testing.assert_array_equal(segment.costs[i], seen.costs[n, t : t + steps])


def test_the_known_part_of_a_cost_is_taken_off():
    """Made-up costs are |s|^2 + |a|^2."""
    episodes: Episodes = vector_episodes(vector_task(), 3)
    states = torch.from_numpy(episodes.frames)
    seen = Sequences.of(states, episodes, 1.0)
    np.testing.assert_allclose(seen.costs, states[:, :-1].square().sum(dim=-1), rtol=1e-4)


# What is predicted


def test_a_constant_input_keeps_its_scale():
    rng = np.random.default_rng(0)
    x = torch.from_numpy(np.column_stack([rng.normal(5, 3, 200), np.full(200, 7.0)])).float()
    y = torch.from_numpy(rng.normal(-2, 0.1, (200, 1))).float()
    network = Standardised(2, 1, LINEAR)
    network.standardise_by(x, y)
    np.testing.assert_allclose(network.x_mean, x.mean(dim=0))
    np.testing.assert_allclose(network.x_std, [float(x[:, 0].std()), 1.0], rtol=1e-6)
    with torch.no_grad():
        network.body[-1].weight.copy_(torch.tensor([[2.0, 0.0]]))
        network.body[-1].bias.zero_()
    expected = y.mean() + y.std() * 2 * (x[:, :1] - x[:, 0].mean()) / x[:, 0].std()
    np.testing.assert_allclose(network(x).detach(), expected, rtol=1e-4)


def test_older_blocks_of_a_window_shift():
    """Two states whose newest latents are predicted are the two windows' states in the basis."""
    rng = np.random.default_rng(4)
    d, window = 2, 3
    frames = torch.from_numpy(rng.normal(size=(50, window + 1, d)))  # newest first
    basis = LatentBasis.whitening(frames[:, 1:])
    dynamics = NeuralDynamics(d * window, d, a, LINEAR)
    dynamics.shift_by(basis)
    before, after = basis.state(frames[:, 1:]), basis.state(frames[:, :-1])
    changes = after[:, :d] - before[:, :d]
    found = dynamics.follow(before.float(), changes.float())
    np.testing.assert_allclose(found, after, atol=2e-4)


def test_predictions_are_fed_back():
    seen, dynamics = Linear.episodes(), Linear.model()
    with torch.no_grad():
        found = dynamics.rolled(seen.states[:, 0], seen.actions)
    np.testing.assert_allclose(found, seen.states[:, 1:], atol=1e-5)


@pytest.mark.parametrize("steps", [1, 3])
def test_the_loss_of_a_segment_is_that_of_what_is_rolled_out(steps):
    """What is trained is what plans are made with."""
    seen = made_up(lengths=(6, 6, 6, 6))
    model = NeuralModel(NeuralDynamics(z, z, a, NeuralFit(widths=(5,))), None)
    model.standardise_by(seen)
    segment = seen.segments(*seen.starts(steps), steps)
    rolled = model.dynamics.rolled(segment.states[:, 0], segment.actions)
    scale = model.dynamics.change.y_std
    expected = ((rolled - segment.states[:, 1:]) / scale).square().mean()
    torch.testing.assert_close(model.loss(segment), expected)


def test_the_loss_counts_costs_of_the_states_that_were_seen():
    seen = made_up(lengths=(6, 6, 6, 6))
    dynamics, cost = NeuralDynamics(z, z, a, LINEAR), NeuralCost(z, LINEAR)
    with_cost, without = NeuralModel(dynamics, cost), NeuralModel(dynamics, None)
    with_cost.standardise_by(seen)
    segment = seen.segments(*seen.starts(2), 2)
    wrong = (cost.of(segment.states[:, :2]) - segment.costs) / cost.y_std
    more = with_cost.loss(segment) - without.loss(segment)
    torch.testing.assert_close(more, wrong.square().mean())


def test_noise_moves_inputs_and_targets_by_their_std():
    seen = Linear.episodes()
    model = NeuralModel(Linear.model(), None)
    segment = seen.segments(*seen.starts(1), 1)
    assert float(model.loss(segment)) < 1e-9
    noise = torch.zeros(len(segment.states), model.entries)
    noise[:, -z:] = 0.5  # of targets alone
    torch.testing.assert_close(model.loss(segment, noise), torch.tensor(0.25))


# How it is judged


def test_r2_is_one_for_the_truth_and_none_for_the_mean():
    rng = np.random.default_rng(0)
    true = torch.from_numpy(rng.normal(size=(30, 4)))
    assert explained(true, true) == 1.0
    assert explained(true.mean(dim=0).expand(30, 4), true) == pytest.approx(0.0)
    found = torch.from_numpy(rng.normal(size=(30, 4)))
    residual = ((found - true) ** 2).sum() / ((true - true.mean(dim=0)) ** 2).sum()
    assert explained(found, true) == pytest.approx(1 - float(residual))


@pytest.mark.parametrize("steps", [1, 4, 100])
def test_predictions_of_the_true_dynamics_explain_all(steps):
    """However far ahead, or as far as episodes go."""
    assert prediction_r2(Linear.model(), Linear.episodes(), steps) == pytest.approx(1.0, abs=1e-6)


def test_predictions_far_ahead_are_judged_far_ahead():
    """Without the action's part one step is partly explained, as computed by hand."""
    seen, dynamics = Linear.episodes(), Linear.model()
    with torch.no_grad():
        dynamics.change.body[-1].weight[:, z:] = 0.0
    start, power = seen.states[:, 0], np.linalg.matrix_power(np.eye(z) + Linear.A, T)
    found = start.numpy() @ power.T - start.numpy()
    expected = explained(torch.from_numpy(found).float(), seen.states[:, -1] - start)
    assert prediction_r2(dynamics, seen, T) == pytest.approx(expected, abs=1e-4)


def test_costs_are_judged_on_live_steps():
    seen, cost = made_up(), NeuralCost(z, LINEAR)
    with torch.no_grad():
        cost.body[-1].weight.zero_()
        cost.body[-1].bias.fill_(0.3)
    true = seen.costs[seen.live]
    expected = 1 - float((0.3 - true).square().sum() / (true - true.mean()).square().sum())
    assert cost_r2(cost, seen) == pytest.approx(expected, abs=1e-5)
