"""The training loop: what it draws, what it weighs, and that stopping changes no bit."""

import copy
import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from bits import digest, through_a_file
from model_problems import vector_episodes, vector_task

from solar_cli.episodes import Episodes
from solar_cli.methods import Diverged
from solar_cli.models import training
from solar_cli.models.controllable_embedding import ControllableEmbedding
from solar_cli.models.frames import FrameModel
from solar_cli.models.latent_model import LatentModel
from solar_cli.models.priors import BayesianLDS, Prior, StandardNormal
from solar_cli.models.training import Dataset, Trainer
from solar_cli.settings.local import Dynamics, Representation, Training, Transition
from solar_cli.streams import Streams

TASK = vector_task(horizon=8)
EPISODES = vector_episodes(TASK, 6)
NAME = "attempt 0"


class Stop(Exception):
    pass


def untrained(prior="linear", task=TASK) -> LatentModel:
    torch.manual_seed(0)
    layers = ({"kind": "linear", "width": 6},)
    settings = Representation.model_validate({"latent": 2, "encoder": layers, "decoder": layers})
    networks = FrameModel(settings, task.observation)
    made: dict[str, Callable[[], Prior]] = {
        "linear": lambda: BayesianLDS(Dynamics(), 2, task, "cpu"),
        "normal": StandardNormal,
        "network": lambda: ControllableEmbedding(Transition(), 2, task, Streams(0), "cpu"),
    }
    return LatentModel(networks, made[prior](), 0.05)


def settings(**changes) -> Training:
    return Training.model_validate({"segments": 3, "length": 4, **changes})


def trainer(pulse=lambda *_: None, seed=0, **changes) -> Trainer:
    return Trainer(settings(**changes), Streams(seed), "cpu", pulse)


def parameters(model: LatentModel) -> dict[str, Any]:
    return {"networks": dict(model.networks.state_dict()), "prior": model.prior.state_dict()}


def terms(metrics: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in metrics.items() if not name.startswith("seconds_")}


def bits(model: LatentModel) -> str:
    return digest(parameters(model))


# Stopping and going on


@pytest.mark.parametrize("prior", ["linear", "normal", "network"])
def test_training_stopped_at_any_pulse_goes_on_with_the_same_bits(monkeypatch, prior):
    monkeypatch.setattr(training, "PULSE_STEPS", 3)
    steps, checkpoints = 12, []

    def save(*_):
        checkpoints.append(through_a_file([parameters(model), whole.state_dict()]))

    model, whole = untrained(prior), trainer(save)
    expected = terms(whole.fit(NAME, model, [EPISODES], steps))
    assert len(checkpoints) == 4  # the last one after the last step
    for networks_and_prior, running in checkpoints:
        resumed, fresh = untrained(prior), trainer()
        resumed.networks.load_state_dict(networks_and_prior["networks"])
        resumed.prior.load_state_dict(networks_and_prior["prior"])
        fresh.load_state_dict(running)
        assert fresh.under_way
        assert terms(fresh.fit(NAME, resumed, [EPISODES], steps)) == expected
        assert bits(resumed) == bits(model)
        assert not fresh.under_way


def test_networks_of_a_prior_are_trained_with_those_of_frames():
    model = untrained("network")
    before = copy.deepcopy(model.prior.state_dict())
    trainer().fit(NAME, model, [EPISODES], 5)
    after = model.prior.state_dict()
    for network in ("transition", "recognition"):
        moved = {
            name for name, old in before[network].items() if (old != after[network][name]).any()
        }
        assert moved == set(before[network]) - {"action_std", "difference_std"}


def test_a_pulse_may_raise(monkeypatch):
    monkeypatch.setattr(training, "PULSE_STEPS", 4)
    model = untrained()
    trainer().fit(NAME, model, [EPISODES], 10)

    def stop(*_):
        raise Stop

    stopped, broken = untrained(), trainer(stop)
    with pytest.raises(Stop):
        broken.fit(NAME, stopped, [EPISODES], 10)
    assert broken.under_way
    state = through_a_file([parameters(stopped), broken.state_dict()])
    resumed, fresh = untrained(), trainer()
    resumed.networks.load_state_dict(state[0]["networks"])
    resumed.prior.load_state_dict(state[0]["prior"])
    fresh.load_state_dict(state[1])
    # A checkpoint may be made again before the training goes on.
    assert digest(fresh.state_dict()) == digest(state[1])
    fresh.fit(NAME, resumed, [EPISODES], 10)
    assert bits(resumed) == bits(model)


def test_a_run_of_another_name_starts_anew():
    model = untrained()
    trainer().fit("iteration 3", model, [EPISODES], 5)
    stale, other = trainer(), untrained()
    stale.load_state_dict({"name": "iteration 2", "step": 4, "terms": {}, "seconds": 0.0})
    stale.fit("iteration 3", other, [EPISODES], 5)
    assert bits(other) == bits(model)


def test_how_often_it_pulses_changes_nothing(monkeypatch):
    found = set()
    for every in (1, 4, 100):
        monkeypatch.setattr(training, "PULSE_STEPS", every)
        model = untrained()
        trainer().fit(NAME, model, [EPISODES], 8)
        found.add(bits(model))
    assert len(found) == 1


def test_a_pulse_says_what_share_is_done(monkeypatch):
    monkeypatch.setattr(training, "PULSE_STEPS", 2)
    said: list[tuple[str, float]] = []
    trainer(lambda *what: said.append(what)).fit(NAME, untrained(), [EPISODES], 8)
    assert [share for _, share in said] == [0.25, 0.5, 0.75, 1.0]
    assert all(NAME in activity for activity, _ in said)


def test_seed_and_name_key_the_draws():
    found = set()
    for seed, name in ((0, "a"), (0, "b"), (1, "a"), (0, "a")):
        model = untrained()
        trainer(seed=seed).fit(name, model, [EPISODES], 3)
        found.add(bits(model))
    assert len(found) == 3


def test_every_step_of_every_run_has_draws_of_its_own():
    noises = []
    for name in ("a", "b"):
        model = untrained()
        loss = model.loss

        def watched(batch, weight, loss=loss):
            noises.append(batch.noise)
            return loss(batch, weight)

        model.loss = watched  # type: ignore[method-assign]
        trainer().fit(name, model, [EPISODES], 4)
    assert len(noises) == 8
    assert len({digest(noise) for noise in noises}) == 8


# What a step draws


def labelled(count: int, task=TASK) -> Episodes:
    """Frames (episode, time, 0) and actions (episode, time): a draw says where it comes from."""
    episode, time = np.meshgrid(np.arange(count), np.arange(task.horizon + 1), indexing="ij")
    frames = np.stack([episode, time, 0 * time], axis=-1).astype(np.float32)
    actions = np.stack([episode, time], axis=-1)[:, :-1].astype(np.float64)
    return Episodes(frames, actions, actions, np.zeros((count, task.horizon)))


def draw(data: Dataset, step=0, **changes):
    stream = Streams(0).generator("minibatch", NAME, step)
    return data.minibatch(settings(**changes), stream, 2)


def test_segments_are_consecutive_frames_of_one_episode_with_their_actions():
    data = Dataset([labelled(5)], "cpu")
    for step in range(30):
        batch = draw(data, step)
        assert batch.frames.shape == (3, 4, 3)
        episode, time = batch.frames[..., 0], batch.frames[..., 1]
        assert bool((episode == episode[:, :1]).all())
        assert torch.equal(time, batch.start[:, None] + torch.arange(4))
        assert torch.equal(batch.actions[..., 0], episode[:, :-1].double())
        assert torch.equal(batch.actions[..., 1], time[:, :-1].double())
        assert batch.noise.shape == (3, 4, 2)


def test_every_segment_of_every_episode_is_equally_likely():
    data = Dataset([labelled(3)], "cpu")
    seen: Counter[tuple[int, int]] = Counter()
    for step in range(600):
        batch = draw(data, step)
        seen.update(zip(batch.frames[:, 0, 0].tolist(), batch.start.tolist(), strict=True))
    assert len(seen) == 3 * (8 + 1 - 4 + 1)
    expected = 1800 / len(seen)
    assert all(abs(n - expected) < 5 * math.sqrt(expected) for n in seen.values())


def test_a_draw_depends_on_its_step_alone():
    data = Dataset([labelled(5)], "cpu")
    alone = draw(data, 17)
    for step in range(17):
        draw(data, step)
    assert digest(list(draw(data, 17))) == digest(list(alone))
    assert not torch.equal(draw(data, 18).noise, alone.noise)


@pytest.mark.parametrize(("share", "count"), [(0.5, 6), (1.0, 12), (0.01, 1), (0.3, 4)])
def test_a_share_of_the_frames_is_decoded_each_once(share, count):
    decoded = draw(Dataset([labelled(5)], "cpu"), decoded=share).decoded.tolist()
    assert len(decoded) == len(set(decoded)) == count
    assert set(decoded) <= set(range(12))


def test_half_of_the_segments_of_fine_tuning_are_new():
    data = Dataset([labelled(20), labelled(4)], "cpu", newest=4)
    data.frames.unflatten(0, (24, -1))[20:, :, 0] += 100  # the newest batch says so
    new = [int((draw(data, step, segments=10).frames[:, 0, 0] >= 100).sum()) for step in range(40)]
    assert min(new) >= 5
    # The other half is drawn from all 24, of which 4 are new.
    assert np.mean(new) == pytest.approx(5 + 5 * 4 / 24, abs=5 * math.sqrt(5 * 0.14 / 40))


def test_segments_are_no_longer_than_episodes():
    assert draw(Dataset([labelled(5)], "cpu"), length=50).frames.shape == (3, 9, 3)


@pytest.mark.parametrize("window", [1, 3])
def test_the_scale_makes_a_minibatch_as_large_as_the_data(window):
    """Averaged over all segments that can be drawn."""
    task = vector_task(horizon=8, window=window)
    data = Dataset([vector_episodes(task, 6)], "cpu")
    model = untrained(task=task)
    length, transitions, starts = 5, 0.0, 0.0
    firsts = 8 + 1 - length + 1
    for start in range(firsts):
        batch = draw(data, length=length)._replace(start=torch.full((3,), start))
        found = model.loss(batch, 1.0)[1]
        transitions += data.scale(batch) * float(found.transitions.n) / firsts
        starts += data.scale(batch) * float(found.starts.n) / firsts
    whole = model.prior.statistics(model.encoded(data.episodes, "cpu"))
    assert starts == pytest.approx(float(whole.starts.n)) == 6
    assert transitions == pytest.approx(float(whole.transitions.n)) == 6 * (9 - window)


# What a step weighs


def weights_and_rates(steps: int, newest=0, **changes):
    """KL weight and learning rate of every step."""
    model, weights, rates = untrained(), [], []
    loss = model.loss

    def watched(batch, weight):
        weights.append(weight)
        return loss(batch, weight)

    model.loss = watched  # type: ignore[method-assign]

    def pulse(*_):
        [group] = own.state_dict()["optimiser"]["param_groups"]
        rates.append(group["lr"])

    own = trainer(pulse, **changes)
    own.fit(NAME, model, [EPISODES], steps, newest=newest)
    return weights, rates


def test_the_kl_weight_is_held_then_rises_linearly(monkeypatch):
    monkeypatch.setattr(training, "PULSE_STEPS", 1)
    schedule = {"kl_start": 0.1, "kl_end": 1.1, "kl_hold": 0.2, "kl_ramp": 0.4}
    weights, _ = weights_and_rates(10, **schedule)
    assert weights == pytest.approx([0.1, 0.1, 0.1, 0.35, 0.6, 0.85, 1.1, 1.1, 1.1, 1.1])
    weights, _ = weights_and_rates(4, **schedule | {"kl_ramp": 0.0, "kl_hold": 0.5})
    assert weights == pytest.approx([0.1, 0.1, 1.1, 1.1])
    weights, _ = weights_and_rates(4, **schedule | {"kl_hold": 0.0, "kl_ramp": 1.0})
    assert weights == pytest.approx([0.1, 0.35, 0.6, 0.85])
    weights, _ = weights_and_rates(3, newest=2, **schedule)
    assert weights == [1.1, 1.1, 1.1]


def test_the_learning_rate_falls_as_a_cosine_or_stays(monkeypatch):
    monkeypatch.setattr(training, "PULSE_STEPS", 1)
    _, rates = weights_and_rates(4, learning_rate=0.01)
    half = 0.005 * (1 + math.sqrt(0.5))
    assert rates == pytest.approx([0.01, half, 0.005, 0.01 - half])
    _, rates = weights_and_rates(3, learning_rate=0.01, schedule="constant")
    assert rates == [0.01] * 3
    _, rates = weights_and_rates(3, learning_rate=0.01, fine_tune_rate=0.003, newest=2)
    assert rates == [0.003] * 3


def test_training_lowers_the_loss():
    model = untrained()
    data = Dataset([EPISODES], "cpu")
    batch = draw(data, 10_000)
    before = float(model.loss(batch, 1.0)[0].detach())
    found = trainer(steps=60).fit(NAME, model, [EPISODES], 60)
    assert float(model.loss(batch, 1.0)[0].detach()) < before - 10.0
    assert set(terms(found)) == {"elbo_reconstruction", "elbo_kl"}
    assert all(math.isfinite(value) for value in found.values())


def test_all_batches_are_learned_from():
    one, two = untrained(), untrained()
    more = vector_episodes(TASK, 3, seed=5)
    trainer().fit(NAME, one, [EPISODES, more], 5)
    trainer().fit(NAME, two, [Episodes.joined([EPISODES, more])], 5)
    assert bits(one) == bits(two)


# What is not finite


def broken(value: float) -> Episodes:
    episodes = copy.deepcopy(EPISODES)
    episodes.frames[..., 0] = value
    return episodes


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_is_divergence(value):
    with pytest.raises(Diverged, match=NAME):
        trainer().fit(NAME, untrained("normal"), [broken(value)], 40)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_divergence_is_seen_before_the_factor_breaks(value):
    with pytest.raises(Diverged):
        trainer().fit(NAME, untrained("linear"), [broken(value)], 40)


def test_divergence_in_the_last_steps_is_seen():
    assert training.PULSE_STEPS > 3
    with pytest.raises(Diverged):
        trainer().fit(NAME, untrained("normal"), [broken(math.nan)], 3)


def test_exploding_steps_are_divergence():
    with pytest.raises(Diverged):
        trainer(learning_rate=1e30).fit(NAME, untrained("normal"), [EPISODES], 40)
