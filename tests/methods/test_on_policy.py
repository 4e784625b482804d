"""PPO and TRPO: what Stable-Baselines3 would learn, from whole episodes, whatever interrupts."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from bits import digest
from method_runs import Run
from sb3_contrib import TRPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from solar_cli.control.actor import Actor
from solar_cli.envs import build_task
from solar_cli.envs.stable_baselines import BatchedVecEnv
from solar_cli.episodes import Episodes, evaluate, roll_out
from solar_cli.errors import UsageError
from solar_cli.methods import Diverged
from solar_cli.methods.on_policy import LEAST_RATE, evaluated_after, seeded
from solar_cli.methods.ppo import Ppo
from solar_cli.settings import TaskSettings, load, load_card, method, resolve
from solar_cli.settings.on_policy import Ppo as PpoSettings
from solar_cli.streams import Streams

ROLLOUT, HORIZON = 4, 6
both = pytest.mark.parametrize("name", ["ppo", "trpo"])


# What is learned


class Flat(BaseFeaturesExtractor):
    """The card's layers as anybody would write them."""

    def __init__(self, space):
        super().__init__(space, 64)
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(math.prod(space.shape), 64), nn.ReLU())

    def forward(self, observations):
        return self.layers(observations)


class OurDraws(BaseCallback):
    """Hands to plain Stable-Baselines3 the streams of our run: starts, noise, permutations."""

    def __init__(self, env, rollouts, monkeypatch):
        super().__init__()
        self.env, self.rollouts, self.done = env, rollouts, 0
        self.noise, self.step_number = None, 0
        env.batched._streams = self.starts(0)
        gaussian = lambda own: own.distribution.mean + own.distribution.stddev * self.drawn()  # noqa: E731
        monkeypatch.setattr(DiagGaussianDistribution, "sample", gaussian)

    def streams(self, rollout):
        iteration = next(i for i in range(1, 99) if evaluated_after(i, 2) > rollout)
        call = rollout - evaluated_after(iteration - 1, 2)
        return Streams(0).under("environment", iteration, call)

    def starts(self, rollout):
        return [self.streams(rollout).generator("reset", i) for i in range(ROLLOUT)]

    def drawn(self):
        self.step_number += 1
        return torch.from_numpy(self.noise[:, self.step_number - 1])

    def _on_rollout_start(self):
        noise = self.streams(self.done).generator("noise")
        self.noise = noise.standard_normal((ROLLOUT, HORIZON, 2), dtype=np.float32)
        self.step_number = 0
        self.env.batched._streams = self.starts(self.done + 1)  # of the restart at the end

    def _on_rollout_end(self):
        entropy = Streams(0).under("learner", "update", self.done).entropy("numpy")
        np.random.seed(entropy % 2**32)
        self.done += 1

    def _on_step(self):
        return self.done < self.rollouts


def plain(name, settings, shared, rollouts, card, monkeypatch):
    """Stable-Baselines3's own loop on our vector environment, set up from its documentation."""
    env = BatchedVecEnv(card, ROLLOUT)
    own = {
        "ppo": dict(n_epochs=4, clip_range=0.2, target_kl=0.02),
        "trpo": dict(sub_sampling_factor=2, cg_max_steps=10, cg_damping=1.0),
    }
    torch.manual_seed(Streams(0).under("learner", "weights").seed63("torch"))
    model = {"ppo": PPO, "trpo": TRPO}[name](
        ActorCriticPolicy,
        env,
        learning_rate=lambda left: 1e-3 * max(left, LEAST_RATE),
        n_steps=HORIZON,
        batch_size=20,
        gamma=0.95,
        gae_lambda=0.9,
        policy_kwargs=dict(
            net_arch=dict(pi=[64], vf=[64]),
            log_std_init=math.log(0.5),
            features_extractor_class=Flat,
            share_features_extractor=shared,
        ),
        device="cpu",
        **own[name],
    )
    started = [parameter.detach().clone() for parameter in model.policy.parameters()]
    # Its own logger leaves a folder in the temporary directory.
    model.set_logger(Logger(folder=None, output_formats=[]))
    draws = OurDraws(env, rollouts, monkeypatch)
    model.learn(settings.horizon * HORIZON, callback=draws)
    assert draws.done == rollouts
    return started, list(model.policy.parameters())


@pytest.fixture
def short_card(tmp_path):
    text = load_card("nav").path.read_text().replace("horizon = 50", f"horizon = {HORIZON}")
    path = tmp_path / "short.toml"
    path.write_text(text)
    return str(path)


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
@both
@pytest.mark.parametrize("shared", ["true", "false"])
def test_plain_stable_baselines_learns_the_same_weights(
    tmp_path, monkeypatch, short_card, name, shared
):
    """Up to the rounding of another batch size; and the learning rate falls in both.

    TRPO's Fisher matrix is well damped: else ten iterations of conjugate gradients make of a
    rounding error in 24 samples what they like.
    """
    sets = [f"network.shared={shared}", "reward_scale=1.0", "horizon=60"]
    sets += ["network.layers=[{ kind = 'linear', width = 64 }]"]
    sets += ["every=2", "damping=1.0"] if name == "trpo" else []
    run = Run(tmp_path / "ours", name, *sets)
    first = [one.detach().clone() for one in run.learner.network.parameters()]
    run.iterate(1, 3)
    settings = run.configuration.method
    started, expected = plain(name, settings, shared == "true", 10, short_card, monkeypatch)
    found = list(run.learner.network.parameters())
    assert [one.shape for one in found] == [one.shape for one in expected]
    for before, own, after, wanted in zip(first, started, found, expected, strict=True):
        assert torch.equal(before, own)
        torch.testing.assert_close(after, wanted, rtol=1e-4, atol=3e-6)
        assert not torch.allclose(after, before, rtol=1e-4, atol=3e-6)


# A rollout


def hand_made(lengths, frames=None):
    """Three steps, states of two numbers."""
    count, rng = len(lengths), np.random.default_rng(0)
    return Episodes(
        rng.normal(size=(count, 4, 2)).astype(np.float32) if frames is None else frames,
        rng.normal(size=(count, 3, 1)),
        np.zeros((count, 3, 1)),
        rng.normal(size=(count, 3)),
        2,
        np.array(lengths),
    )


def learner_of_states(**sets):
    """A learner of PPO on a task of states with a window of two."""
    task = TaskSettings.model_validate(
        {
            "simulator": "none",
            "horizon": 3,
            "observation": {"kind": "state", "width": 2, "window": 2},
            "action": {"size": 1, "bound": 3.0},
            "exploration": {"std": 0.2},
        }
    )
    budget = {"desk": 8, "full": 8}
    settings = PpoSettings(rollout=4, horizon=100, budget=budget, minibatch=4, **sets)
    return Ppo(settings, task, Streams(0), "cpu", lambda *_: None)


def acted(learner, episodes):
    """An actor that was shown these episodes."""
    actor = learner.policy
    state = actor.start(len(episodes), np.random.default_rng(1))
    for t in range(episodes.horizon):
        shown = episodes.frames[:, [max(t - 1, 0), t]]
        actor.act(shown, t, state)
    return actor


def test_advantages_are_those_of_each_episode_on_its_own():
    """Generalised advantage estimation as a sum, with what follows an end, and a cut horizon."""
    learner = learner_of_states(discount=0.9, gae_lambda=0.8, reward_scale=0.5)
    episodes = hand_made([3, 1, 2, 3])
    actor = acted(learner, episodes)
    buffer = learner.buffer(episodes, actor)
    values, costs = actor.taken().values, episodes.costs
    expected = []
    for row, length in enumerate(episodes.lengths):
        rewards = [-0.5 * cost for cost in costs[row]]
        # After the end: all that is still to be paid; after the horizon: what its state is worth.
        last = episodes.frames[row, [2, 3]][None]
        after = actor.values(last)[0] if length == 3 else 0.0
        tail = sum(0.9 ** (t - length) * rewards[t] for t in range(length, 3)) + after
        worth = [*values[row, :length], tail]
        errors = [rewards[t] + 0.9 * worth[t + 1] - worth[t] for t in range(length)]
        expected += [
            sum((0.9 * 0.8) ** (k - t) * errors[k] for k in range(t, length)) for t in range(length)
        ]
    np.testing.assert_allclose(buffer.advantages[:, 0], expected, rtol=1e-5, atol=1e-6)
    live = values[episodes.live_steps]
    np.testing.assert_allclose(buffer.returns[:, 0], expected + live, rtol=1e-5, atol=1e-6)


def test_a_buffer_holds_live_steps_with_what_was_seen_drawn_and_thought_of():
    learner, episodes = learner_of_states(), hand_made([3, 1, 2, 3])
    actor = acted(learner, episodes)
    learner.model.rollout_buffer = learner.buffer(episodes, actor)
    with seeded(Streams(3)):
        [samples] = learner.model.rollout_buffer.get(None)
    assert len(samples.actions) == 9
    frames = torch.from_numpy(episodes.frames)
    seen = [(row, t) for row, length in enumerate(episodes.lengths) for t in range(length)]
    expected = torch.stack([frames[row, [max(t - 1, 0), t]].flatten() for row, t in seen])
    order = [int((expected == one).all(dim=1).nonzero()) for one in samples.observations]
    assert sorted(order) == list(range(9))
    values, log_probs, _ = learner.network.evaluate_actions(samples.observations, samples.actions)
    torch.testing.assert_close(samples.old_values, values[:, 0], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(samples.old_log_prob, log_probs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("at_once", [None, 2])
def test_an_actor_notes_what_it_drew_before_clipping(at_once):
    """Of groups of episodes, too; what is executed is that times the bound, clipped."""
    settings = load_card("nav").task.model_copy(update={"horizon": 5})
    task = build_task(settings)
    task.at_once = at_once
    learner = learner_of("ppo", settings)
    actor, streams = Actor(learner.network, settings), Streams(2)
    resets = [streams.generator("reset", i) for i in range(4)]
    episodes = roll_out(task, settings, actor, resets, streams.generator("noise")).episodes
    taken = actor.taken()
    assert taken.actions.shape == (4, 5, 2)
    bound = settings.action.bound
    assert (np.abs(taken.actions) > 1).any()
    np.testing.assert_array_equal(
        episodes.actions, np.clip(taken.actions.astype(float) * bound, -bound, bound)
    )
    noise = streams.generator("noise").standard_normal((4, 5, 2), dtype=np.float32)
    drawn = episodes.action_means / bound + 0.5 * noise
    np.testing.assert_allclose(taken.actions, drawn, rtol=1e-5, atol=1e-6)


def learner_of(name, task, *sets):
    sets = [f"methods.{name}.{text}" for text in sets]
    settings = resolve(load_card("nav"), name, "smoke", sets).configuration.method
    return load(method(name).learner)(settings, task, Streams(0), "cpu", lambda *_: None)


def shown_to_the_layers(learner, observations):
    shown = []
    body = learner.network.pi_features_extractor.body
    body.register_forward_pre_hook(lambda _, given: shown.append(given[0]))
    learner.network.get_distribution(torch.from_numpy(observations))
    return shown[0].detach().numpy()


def test_every_entry_of_a_state_is_standardised_but_for_a_constant_one():
    learner = learner_of_states()
    states = np.random.default_rng(0).normal(5.0, [3, 1, 7, 0.1], (200, 4)).astype(np.float32)
    states[:, 1] = 7.0
    learner.network.standardise_by(states)
    found = shown_to_the_layers(learner, states)
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(found.std(axis=0), [1, 0, 1, 1], atol=1e-4)


def test_images_are_standardised_by_their_mean_and_one_scale():
    learner = learner_of("ppo", load_card("nav").task, 'network.input="standardised"')
    images = np.random.default_rng(0).integers(0, 256, (150, 2, 32, 32), dtype=np.uint8)
    images[:, 1] //= 8
    learner.network.standardise_by(images)
    found = shown_to_the_layers(learner, images)
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=1e-4)
    assert found.std() == pytest.approx(1.0, abs=1e-4)
    ratio = found[:, 0].std() / found[:, 1].std()
    assert ratio == pytest.approx(images[:, 0].std() / images[:, 1].std(), rel=0.02)


@both
def test_the_first_rollout_alone_standardises(tmp_path, name):
    run = Run(tmp_path, name, 'network.input="standardised"')
    extractor = run.learner.network.vf_features_extractor
    assert float(extractor.scale) == 1.0
    run.iterate(1, 1)
    first = digest([extractor.mean, extractor.scale])
    assert float(extractor.scale) < 1.0
    assert float(extractor.mean.max()) > 0.0
    run.iterate(2, 2)
    assert digest([extractor.mean, extractor.scale]) == first


# Evaluations


def test_evaluations_are_evenly_spaced_on_a_logarithmic_axis():
    points = [evaluated_after(k, 20) for k in range(80)]
    assert points[:12] == [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]
    assert points == sorted(set(points))
    steps = np.diff(np.log10([p for p in points if p >= 10]))
    assert steps.min() > 0.5 / 20
    assert steps.max() < 1.5 / 20 + 1e-9
    assert {20, 40, 100, 200, 400, 500, 1000, 2000, 4000} <= set(points)
    assert [evaluated_after(k, 2) for k in range(6)] == [0, 1, 3, 10, 32, 100]


@both
def test_an_iteration_is_as_many_rollouts_as_lie_between_evaluations(tmp_path, name):
    run = Run(tmp_path, name).iterate(1, 3)
    assert run.environment.episodes == 10 * ROLLOUT
    assert run.environment.batches() == []
    assert not tmp_path.exists() or not list(tmp_path.iterdir())


@both
def test_metrics_are_means_over_the_updates_of_an_iteration(tmp_path, name, monkeypatch):
    run = Run(tmp_path, name)
    said, train = [], type(run.learner.model).train

    def noting(model):
        train(model)
        said.append(dict(model.logger.name_to_value))

    monkeypatch.setattr(type(run.learner.model), "train", noting)
    run.iterate(1, 3)
    assert len(said) == 10
    found = run.metrics[2]
    assert found["value_loss"] == pytest.approx(np.mean([s["train/value_loss"] for s in said[3:]]))
    assert found["policy_std"] == pytest.approx(np.mean([s["train/std"] for s in said[3:]]))
    assert {"policy_kl", "explained_variance", "learning_rate"} <= set(found)
    assert all(math.isfinite(value) for value in found.values())


def test_the_learning_rate_falls_over_the_cards_horizon_and_stays_above_zero(tmp_path):
    run = Run(tmp_path, "ppo", "horizon=80").iterate(1, 4)
    rates = [metrics["learning_rate"] for metrics in run.metrics]
    shares = [1 - 4 * n / 80 for n in range(1, 33)]
    expected = [1e-3 * max(share, 0.05) for share in shares]
    of_iterations = np.split(np.array(expected), [1, 3, 10])
    assert rates == pytest.approx([part.mean() for part in of_iterations])


# Interruptions


@both
def test_a_run_interrupted_anywhere_ends_with_the_same_bits(tmp_path, name):
    """At every pulse, and while episodes are under way."""
    saved = []

    def halfway(iteration, costs):
        saved.append((iteration, whole.state()))
        return costs

    whole = Run(
        tmp_path / "whole",
        name,
        pulse=lambda *_: saved.append((whole.environment.iteration, whole.state())),
        costs=halfway,
    )
    whole.iterate(1, 3)
    assert len(saved) == 10 * (HORIZON + 1)
    for iteration, state in saved[:: HORIZON // 2 + 1]:
        resumed = Run(tmp_path / "resumed", name, costs=lambda _, costs: costs)
        resumed.restore(state).iterate(iteration, 3)
        assert repr(resumed.metrics) == repr(whole.metrics[iteration - 1 :])
        assert resumed.bits() == whole.bits()


@both
def test_a_cell_has_its_bits_whatever_global_generators_hold(tmp_path, name):
    runs = []
    for seed, state in ((0, 1), (0, 2), (1, 1)):
        np.random.seed(state)
        torch.manual_seed(state)
        before = np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()
        runs.append(Run(tmp_path / str(len(runs)), name, seed=seed).iterate(1, 2))
        assert (np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()) == before
    assert runs[0].bits() == runs[1].bits()
    assert runs[0].bits() != runs[2].bits()


@both
def test_judging_changes_nothing(tmp_path, name):
    quiet, judged = (Run(tmp_path / word, name) for word in ("quiet", "judged"))
    task = judged.configuration.task
    for iteration in (1, 2, 3):
        evaluate(build_task(task), task, judged.learner.policy, 5, Streams(9))
        quiet.iterate(iteration, iteration)
        judged.iterate(iteration, iteration)
    assert quiet.bits() == judged.bits()


# Early endings


class Ending:
    """Navigation that is over at a step of each episode's own; its last frames are ``rubbish``."""

    def __init__(self, task, rubbish, after):
        self._task, self._rubbish, self._after = task, rubbish, after

    def __getattr__(self, name):
        return getattr(self._task, name)

    def reset(self, streams):
        frames = self._task.reset(streams)
        self._step = 0
        self._lengths = 1 + (1000 * self._task.truth()[:, 0]).astype(int) % HORIZON
        return frames

    def step(self, actions):
        over = self.ended()
        frames, costs = self._task.step(actions)
        self._step += 1
        frames[over] = self._rubbish
        return frames, np.where(over, self._after, costs)

    def ended(self):
        return self._step >= self._lengths


@both
def test_what_is_seen_after_an_end_does_not_matter_and_what_it_costs_does(tmp_path, name):
    states = {}
    for rubbish, after in ((0, 3.0), (200, 3.0), (0, 9.0)):
        run = Run(
            tmp_path / f"{rubbish}-{after}",
            name,
            wrap=lambda task, r=rubbish, a=after: Ending(task, r, a),
        ).iterate(1, 2)
        states[rubbish, after] = digest(run.learner.state_dict())
    assert states[0, 3.0] == states[200, 3.0]
    assert states[0, 3.0] != states[0, 9.0]


# What is not finite


@both
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_cost_that_is_not_finite_is_divergence(tmp_path, name, value):
    broken = lambda iteration, costs: costs * (value if iteration == 2 else 1)  # noqa: E731
    run = Run(tmp_path, name, costs=broken).iterate(1, 1)
    with pytest.raises(Diverged, match="iteration 2"):
        run.iterate(2, 2)


@both
def test_a_network_that_is_not_finite_is_divergence(tmp_path, name):
    run = Run(tmp_path, name, "learning_rate=1e30")
    with pytest.raises(Diverged, match="update 1"):
        run.iterate(1, 1)


def test_an_error_that_has_another_cause_is_not_divergence(tmp_path, monkeypatch):
    run = Run(tmp_path, "ppo")

    def broken():
        raise ValueError("something else")

    monkeypatch.setattr(run.learner, "model", SimpleNamespace(**vars(run.learner.model)))
    run.learner.model.train = broken
    run.learner.model._update_current_progress_remaining = lambda *_: None
    with pytest.raises(ValueError, match="something else"):
        run.iterate(1, 1)


def test_a_step_of_trpo_needs_data(tmp_path):
    with pytest.raises(UsageError, match="every = 13"):
        Run(tmp_path, "trpo", f"every={ROLLOUT * HORIZON // 2 + 1}")
