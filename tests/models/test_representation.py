"""A representation is watched, repaired, fixed or fine-tuned, and resumed with the same bits."""

import math
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from bits import digest, through_a_file
from model_problems import vector_episodes, vector_task

from solar_cli import stopwatch
from solar_cli.episodes import Batch, Episodes, window_indices
from solar_cli.errors import UsageError
from solar_cli.models import representation, training
from solar_cli.models.latent_model import LatentModel
from solar_cli.models.priors import BayesianLDS
from solar_cli.models.representation import Representation
from solar_cli.models.smoothing import linear_dynamics
from solar_cli.models.training import Trainer
from solar_cli.settings.local import Solar
from solar_cli.streams import Streams

TASK = vector_task(horizon=7, window=2)
FIRST = vector_episodes(TASK, 14)


class Stop(Exception):
    pass


class Collected:
    """A learner's experience: the iteration, and one batch for each up to it."""

    def __init__(self, *batches: Episodes) -> None:
        self.batches = batches
        self.iteration = len(batches)

    def recent(self, count: int) -> list[Episodes]:
        return list(self.batches[-count:])


class Scores:
    """Stands for the cost fit: gives what it is told, and keeps what it is asked about."""

    def __init__(self, *scores: float) -> None:
        self.scores = scores
        self.states: list[torch.Tensor] = []
        self.episodes: list[list[Episodes]] = []

    def __call__(self, model: Representation, episodes: list[Episodes]) -> float:
        self.states.append(model.embed(FIRST))
        self.episodes.append(episodes)
        return self.scores[min(len(self.states), len(self.scores)) - 1]


@pytest.fixture(autouse=True)
def short_and_easily_pleased(monkeypatch):
    """A pulse every second step; only the cost score tells what is alive."""
    monkeypatch.setattr(training, "PULSE_STEPS", 2)
    monkeypatch.setattr(representation, "LEAST_EXPLAINED", -math.inf)
    monkeypatch.setattr(representation, "ACTIVE_SHARE", 0.0)


SMOOTHER = {"posterior": "smoother", "hidden": 1}


def make(
    score=None, pulse=lambda *_: None, seed=0, task=TASK, dynamics=(), **changes
) -> Representation:
    layers = ({"kind": "linear", "width": 6},)
    settings = Solar.model_validate(
        {
            "batches": {"initial": 14, "noisy": 6},
            "budget": {"desk": 1, "full": 1},
            "representation": {"latent": 2, "encoder": layers, "decoder": layers},
            "dynamics": dict(dynamics),
            "training": {"steps": 4, "segments": 3, "length": 4, **changes},
        }
    )
    return Representation(
        settings,
        task,
        lambda: linear_dynamics(settings.dynamics, 2, task, "cpu"),
        Scores(1.0) if score is None else score,
        Streams(seed),
        "cpu",
        pulse,
    )


def losses_by_attempt(seen: list[float], model_of):
    """A pulse that keeps the ELBO of every finished attempt."""

    def pulse(*_):
        candidates = model_of().state_dict()["candidates"]
        seen[:] = [metrics["held_out_elbo"] for _, metrics, _ in candidates]

    return pulse


# Watching and repairing


def test_a_dead_representation_is_discarded_and_the_next_one_kept():
    score = Scores(0.05, 0.9)
    model = make(score)
    metrics = model.update(Collected(FIRST))
    first, second = score.states
    assert torch.equal(model.embed(FIRST), second)
    assert not torch.allclose(second, first)
    assert metrics["discarded_trainings"] == 1.0
    assert metrics["seconds_discarded"] > 0.0
    assert metrics["held_out_cost_r2"] == 0.9
    assert metrics["alive"] == 1.0


def test_a_living_representation_is_the_last_that_is_trained():
    score = Scores(0.9)
    metrics = make(score).update(Collected(FIRST))
    assert len(score.states) == 1
    assert metrics["discarded_trainings"] == metrics["seconds_discarded"] == 0.0


def test_of_living_representations_that_say_little_of_costs_the_best_is_kept():
    score = Scores(0.15, 0.3, 0.2)
    model = make(score)
    metrics = model.update(Collected(FIRST))
    assert torch.equal(model.embed(FIRST), score.states[1])
    assert metrics["discarded_trainings"] == 2.0
    assert metrics["held_out_cost_r2"] == 0.3
    assert metrics["alive"] == 1.0


def test_a_living_representation_ranks_above_every_dead_one():
    def candidate(alive, **metrics):
        return representation.Candidate(alive, metrics, {})

    living = candidate(True, held_out_cost_r2=0.2, held_out_elbo=-50.0)
    dead = candidate(False, held_out_cost_r2=0.05, held_out_elbo=7000.0)
    assert living.rank() > dead.rank()


def test_one_that_says_enough_of_costs_is_the_last_that_is_trained():
    score = Scores(0.69, 0.71, 0.9)
    metrics = make(score).update(Collected(FIRST))
    assert len(score.states) == 2
    assert metrics["held_out_cost_r2"] == 0.71


def test_judging_takes_what_encoding_takes_in_an_update_and_no_training(monkeypatch):
    clock, calls, fit = Mock(**{"monotonic.return_value": 0.0}), [], Trainer.fit
    encoded = LatentModel.encoded

    def slowly(model, episodes, device):
        calls.append(episodes)
        clock.monotonic.return_value += 1.0
        return encoded(model, episodes, device)

    def more_slowly(*arguments, **named):
        clock.monotonic.return_value += 100.0
        return fit(*arguments, **named)

    monkeypatch.setattr(stopwatch, "time", clock)
    monkeypatch.setattr(LatentModel, "encoded", slowly)
    monkeypatch.setattr(Trainer, "fit", more_slowly)
    model = make(fine_tune_steps=4)
    batches = [FIRST, vector_episodes(TASK, 6)]
    for iteration in (1, 2):
        calls.clear()
        metrics = model.update(Collected(*batches[:iteration]))
        assert metrics["seconds_judging"] == len(calls) > 0
        model.embed(FIRST)  # control does, between updates


@pytest.mark.parametrize(("threshold", "least"), [("LEAST_EXPLAINED", 1.0), ("ACTIVE_SHARE", 1.1)])
def test_unexplained_frames_and_sleeping_latents_are_dead_too(monkeypatch, threshold, least):
    monkeypatch.setattr(representation, threshold, least)
    score = Scores(1.0)
    with pytest.warns(UserWarning, match="no representation of 3 is alive"):
        metrics = make(score).update(Collected(FIRST))
    assert len(score.states) == 3
    assert metrics["alive"] == 0.0
    assert metrics["least_explained_variance"] < 1.0


def test_of_dead_representations_the_one_of_best_held_out_elbo_is_kept():
    seen: list[float] = []
    score = Scores(0.0)
    model = make(score, losses_by_attempt(seen, lambda: model))
    with pytest.warns(UserWarning, match="alive"):
        metrics = model.update(Collected(FIRST))
    assert len(score.states) == 3
    assert metrics["discarded_trainings"] == 2.0
    assert len(seen) == 2
    assert metrics["held_out_elbo"] >= max(seen)
    best = int(np.argmax([*seen, -math.inf]))
    if metrics["held_out_elbo"] > max(seen):
        best = 2
    assert torch.equal(model.embed(FIRST), score.states[best])


def test_a_living_one_is_kept_whatever_its_elbo():
    # The second attempt is alive; both are trained so briefly that seeds decide about ELBOs.
    for seed in range(20):
        seen: list[float] = []
        score = Scores(0.0, 1.0)
        model = make(score, losses_by_attempt(seen, lambda: model), seed=seed)  # noqa: B023
        metrics = model.update(Collected(FIRST))
        if metrics["held_out_elbo"] < seen[0]:
            break
    else:
        pytest.fail("no seed's second training is worse than its first")
    assert torch.equal(model.embed(FIRST), score.states[1])


@pytest.mark.filterwarnings("ignore:no representation")
def test_attempts_are_judged_on_episodes_that_they_did_not_learn_from(monkeypatch):
    judged, judge = [], Representation._judge
    monkeypatch.setattr(
        Representation, "_judge", lambda self, frames: judged.append(frames) or judge(self, frames)
    )
    standardised, original = [], representation.FrameModel.standardise_by
    monkeypatch.setattr(
        representation.FrameModel,
        "standardise_by",
        lambda self, frames: standardised.append(frames.numpy()) or original(self, frames),
    )
    score = Scores(0.0)
    make(score, held_out=0.3, attempts=2).update(Collected(FIRST))
    kept = round(0.3 * 14)
    assert len(judged) == len(score.episodes) == len(standardised) == 2
    for [held_out], [every] in zip(judged, score.episodes, strict=True):
        np.testing.assert_array_equal(held_out.frames, FIRST.frames[-kept:])
        np.testing.assert_array_equal(every.frames, FIRST.frames)
    for frames in standardised:
        np.testing.assert_array_equal(frames, FIRST.frames[:-kept].reshape(-1, 3))


def test_an_active_latent_is_one_whose_mean_carries_its_variance(monkeypatch):
    model = make()
    model.update(Collected(FIRST))
    monkeypatch.setattr(representation, "ACTIVE_SHARE", 0.9)
    segments = model._model.encoded(FIRST, "cpu")
    # One latent varies as its variance is, so its mean carries half; the other hardly has any.
    spread = segments.mean.flatten(0, 1).var(dim=0)
    variance = torch.stack([spread[0], 0.01 * spread[1]])
    monkeypatch.setattr(
        model._model,
        "encoded",
        lambda *_: segments._replace(variance=variance.expand_as(segments.variance)),
    )
    assert model._judge([FIRST])["active_latents"] == 1.0


def test_segments_must_be_longer_than_windows():
    with pytest.raises(UsageError, match=r"training\.length = 2.*window of 2"):
        make(length=2)
    with pytest.raises(UsageError, match=r"horizon = 1.*window of 2"):
        make(task=vector_task(horizon=1, window=2))


# Weights and seeds


def test_first_weights_depend_on_seed_and_attempt_alone():
    torch.manual_seed(123)
    before = torch.get_rng_state()
    first = digest(make().state_dict())
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(456)
    assert digest(make().state_dict()) == first
    assert digest(make(seed=1).state_dict()) != first
    # The second attempt is what it is, whatever the first one was.
    trained, again = (make(Scores(0.0, 1.0), attempts=attempts) for attempts in (2, 3))
    for model in (trained, again):
        model.update(Collected(FIRST))
    assert torch.equal(trained.embed(FIRST), again.embed(FIRST))


@pytest.mark.filterwarnings("ignore:no representation")
def test_every_attempt_starts_from_weights_of_its_own(monkeypatch):
    starts, fit = [], training.Trainer.fit

    def watched(self, name, model, *rest, **more):
        starts.append(digest([p.detach() for p in model.networks.parameters()]))
        return fit(self, name, model, *rest, **more)

    monkeypatch.setattr(training.Trainer, "fit", watched)
    make(Scores(0.0)).update(Collected(FIRST))
    assert len(set(starts)) == len(starts) == 3


# Stopping and going on


def checkpoints(batches: list[Collected], **changes) -> tuple[list[Any], str, list[dict]]:
    """Updates done, state and judged attempts at every pulse; the final digest; all metrics."""
    saved: list[Any] = []

    def pulse(*_):
        saved.append((len(metrics), through_a_file(model.state_dict()), len(score.states)))

    score = Scores(*SCORES)
    model = make(score, pulse, **changes)
    metrics: list[dict[str, float]] = []
    for batch in batches:
        metrics.append(model.update(batch))
    return saved, digest(model.state_dict()), metrics


SCORES = (0.01, 0.3, 0.9)


def without_seconds(metrics: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in metrics.items() if not name.startswith("seconds_")}


@pytest.mark.parametrize("fine_tune_steps", [0, 4])
@pytest.mark.parametrize("kills", [False, True])
def test_an_update_stopped_at_any_pulse_goes_on_with_the_same_bits(
    monkeypatch, fine_tune_steps, kills
):
    if kills:  # fine-tuning is taken back, as what was alive is not any more
        monkeypatch.setattr(Representation, "_alive", staticmethod(lambda metrics: next(alive)))
        alive = iter([True] * 3 + [True, False] * 99)
    second = vector_episodes(TASK, 6, seed=7)
    batches = [Collected(FIRST), Collected(FIRST, second)]
    changes = {"fine_tune_steps": fine_tune_steps, "attempts": 3}
    saved, expected, metrics = checkpoints(batches, **changes)
    assert len(saved) == 6 + fine_tune_steps // 2  # three attempts, one dead and one poor
    assert metrics[0]["discarded_trainings"] == 2.0
    if fine_tune_steps:
        assert metrics[1]["fine_tuning_taken_back"] == float(kills)
    for number, state, judged in saved:
        alive = iter([True] * (3 - judged) + [True, False] * 99)
        resumed = make(Scores(*[*SCORES, 0.9][judged:]), **changes)
        resumed.load_state_dict(state)
        for batch, before in list(zip(batches, metrics, strict=True))[number:]:
            assert without_seconds(resumed.update(batch)) == without_seconds(before)
        assert digest(resumed.state_dict()) == expected


@pytest.mark.parametrize("fine_tune_steps", [0, 4])
def test_a_checkpoint_can_be_made_again_before_anything_goes_on(fine_tune_steps):
    batches = [Collected(FIRST), Collected(FIRST, vector_episodes(TASK, 6, seed=7))]
    for _, state, _ in checkpoints(batches, fine_tune_steps=fine_tune_steps)[0]:
        fresh = make()
        fresh.load_state_dict(state)
        assert digest(through_a_file(fresh.state_dict())) == digest(state)


# Later iterations


def conditioned(model: Representation, *batches: Episodes) -> list[torch.Tensor]:
    """The factor of a fresh prior after the closed form on these batches."""
    closed = BayesianLDS(model.settings.dynamics, 2, TASK, "cpu")
    closed.conclude(model._model.encoded(Episodes.joined(list(batches)), "cpu"))
    return list(closed.factor)


def own_factor(model: Representation) -> list[torch.Tensor]:
    return list(model.dynamics_prior([], as_it_stands=True).factor)


def test_a_first_training_ends_with_the_exact_factor_of_what_it_learned_from():
    model = make(held_out=0.3)
    model.update(Collected(FIRST))
    assert digest(own_factor(model)) == digest(conditioned(model, FIRST[: -round(0.3 * 14)]))


@pytest.mark.parametrize("fine_tune_steps", [0, 3])
def test_the_same_networks_encode_no_collected_frame_twice(monkeypatch, fine_tune_steps):
    """What is remembered is what encoding anew gives, also of networks that have changed since."""
    named = [
        replace(vector_episodes(TASK, 5, seed=seed), batch=Batch(seed, 0)) for seed in (1, 2, 3)
    ]
    model = make(fine_tune_steps=fine_tune_steps)
    for last in (1, 2, 3):
        model.update(Collected(*named[:last]))
        for known in named[:last]:
            unknown = replace(known, batch=None)
            assert torch.equal(model.embed(known), model.embed(unknown))
    encoded: list[int] = []
    encoded_by = model._model.encoded
    monkeypatch.setattr(
        model._model, "encoded", lambda e, device: encoded.append(len(e)) or encoded_by(e, device)
    )
    for known in named:
        model.embed(known)
    assert encoded == []
    model.embed(named[0][:3])
    assert encoded == [3]


def test_no_attempt_is_judged_by_the_latents_of_the_one_before():
    """Whether what is encoded may be remembered, by the name of its batch, changes nothing."""
    models = [make(Scores(0.0, 1.0), attempts=2) for _ in range(2)]
    named = replace(FIRST, batch=Batch(1, 0))
    found = [
        without_seconds(model.update(Collected(first)))
        for model, first in zip(models, (FIRST, named), strict=True)
    ]
    assert found[0]["discarded_trainings"] == 1.0
    assert found[1] == found[0]
    assert digest(models[1].state_dict()) == digest(models[0].state_dict())


def test_a_frozen_encoder_keeps_its_states_and_learns_its_dynamics():
    model = make(buffer=2)
    batches = [FIRST, *(vector_episodes(TASK, 5, seed=seed) for seed in (1, 2))]
    model.update(Collected(batches[0]))
    assert model.moved_in == 1
    states, basis, factor = model.embed(FIRST), model.basis, own_factor(model)
    for last in (2, 3):
        model.update(Collected(*batches[:last]))
        assert model.moved_in == 1
    assert torch.equal(model.embed(FIRST), states)
    assert digest(list(model.basis)) == digest(list(basis))
    assert digest(own_factor(model)) == digest(conditioned(model, *batches[1:]))
    assert digest(own_factor(model)) != digest(factor)


def test_line_7_is_told_of_dynamics_by_older_episodes_alone():
    """What judges how much to trust the factor has not been part of it."""
    model = make()
    older = [vector_episodes(TASK, 5, seed=seed) for seed in (1, 2)]
    model.update(Collected(FIRST))
    model.update(Collected(FIRST, *older))
    prior = model.dynamics_prior(older, as_it_stands=False)
    assert digest(list(prior.factor)) == digest(conditioned(model, *older))
    assert model.dynamics_prior([], as_it_stands=False).factor is None
    assert digest(list(prior.basis)) == digest(list(model.basis))
    assert prior.latent == 2


def test_fine_tuning_moves_the_states_within_a_fixed_basis():
    model = make(fine_tune_steps=4)
    model.update(Collected(FIRST))
    states, basis = model.embed(FIRST), model.basis
    metrics = model.update(Collected(FIRST, vector_episodes(TASK, 6, seed=7)))
    assert model.moved_in == 2
    assert metrics["fine_tuning_taken_back"] == 0.0
    assert not torch.allclose(model.embed(FIRST), states)
    assert digest(list(model.basis)) == digest(list(basis))
    assert {"elbo_reconstruction", "elbo_kl", "held_out_elbo"} <= set(metrics)


def test_fine_tuning_is_judged_on_what_it_has_not_seen():
    """The metrics of a batch are those of the model before it was trained on the batch."""
    tuned, frozen = make(fine_tune_steps=4), make()
    second = vector_episodes(TASK, 6, seed=7)
    found = [
        [model.update(batch) for batch in (Collected(FIRST), Collected(FIRST, second))][1]
        for model in (tuned, frozen)
    ]
    for name in ("held_out_elbo", "held_out_kl", "least_explained_variance", "active_latents"):
        assert found[0][name] == found[1][name]


def test_fine_tuning_that_kills_is_taken_back(monkeypatch):
    model = make(fine_tune_steps=4)
    model.update(Collected(FIRST))
    before = digest(model.state_dict()["parameters"]["networks"])
    answers = iter([True, False])
    monkeypatch.setattr(Representation, "_alive", staticmethod(lambda _: next(answers)))
    second = vector_episodes(TASK, 6, seed=7)
    metrics = model.update(Collected(FIRST, second))
    assert metrics["fine_tuning_taken_back"] == 1.0
    assert model.moved_in == 1
    assert digest(model.state_dict()["parameters"]["networks"]) == before
    # What the newest episodes say of the dynamics is not taken back.
    assert digest(own_factor(model)) == digest(conditioned(model, FIRST, second))


def test_judging_decodes_a_bounded_number_of_frames(monkeypatch):
    model, decoded = make(), []
    model.update(Collected(FIRST))
    monkeypatch.setattr(representation, "JUDGED_FRAMES", 20)
    decoder = model._model.networks.decoder
    decoder.register_forward_hook(lambda _, given, __: decoded.append(len(given[0])))
    metrics = model.update(Collected(FIRST, vector_episodes(TASK, 6, seed=7)))
    assert 10 < max(decoded) <= 20 < 6 * (TASK.horizon + 1)
    assert math.isfinite(metrics["held_out_elbo"])


def test_what_was_dead_before_fine_tuning_is_tuned_all_the_same(monkeypatch):
    model = make(fine_tune_steps=4)
    model.update(Collected(FIRST))
    monkeypatch.setattr(Representation, "_alive", staticmethod(lambda _: False))
    metrics = model.update(Collected(FIRST, vector_episodes(TASK, 6, seed=7)))
    assert metrics["fine_tuning_taken_back"] == 0.0
    assert model.moved_in == 2


def test_metrics_of_an_update_are_finite_numbers():
    model = make()
    for iteration in (1, 2):
        metrics = model.update(Collected(*[FIRST] * iteration))
        assert all(isinstance(value, float) for value in metrics.values())
        assert all(math.isfinite(value) for value in metrics.values())
        assert {"kl_dynamics", "kl_initial", "held_out_elbo"} <= set(metrics)


# States


def test_states_are_the_basis_of_windows_of_single_frames():
    model = make()
    model.update(Collected(FIRST))
    states = model.embed(FIRST)
    assert states.shape == (14, 8, 4)
    assert states.dtype == torch.float64
    latents = torch.stack([model.follow(FIRST.frames[:, t], t, None, None)[0] for t in range(8)], 1)
    for t, frames in enumerate(window_indices(7, 2)):
        newest_first = [latents[:, frame] for frame in reversed(frames)]
        expected = torch.cat(newest_first, dim=1) @ model.basis.A.T + model.basis.b
        # Frames are encoded in float32, in batches of other sizes.
        torch.testing.assert_close(states[:, t], expected, rtol=1e-4, atol=1e-4)


def test_states_are_white_on_what_was_learned_from():
    model = make()
    model.update(Collected(FIRST))
    z = model.embed(FIRST[:-2])[..., :2].flatten(0, 1).numpy()
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=1e-8)
    np.testing.assert_allclose(np.cov(z.T), np.eye(2), atol=1e-8)


@pytest.mark.parametrize("fine_tune_steps", [0, 4])
def test_a_smoothers_states_are_followed_with_the_actions_that_were_executed(fine_tune_steps):
    """Also after its factors have learned more; an action beyond the bound was clipped."""
    task = vector_task(horizon=7)
    made_of = [vector_episodes(task, 14), vector_episodes(task, 6, seed=7)]
    model = make(task=task, dynamics=SMOOTHER, fine_tune_steps=fine_tune_steps)
    for iteration in (1, 2):
        model.update(Collected(*made_of[:iteration]))
        wanted = np.random.default_rng(0).normal(0, 2.0, (6, 7, 2))
        episodes = replace(made_of[1], actions=np.clip(wanted, -1.0, 1.0))
        assert (wanted != episodes.actions).any()
        states, belief, actions = model.embed(episodes), None, None
        assert states.shape == (6, 8, 2 + 1) == (6, 8, model.state_size)
        for t in range(8):
            latents, belief = model.follow(episodes.frames[:, t], t, belief, actions)
            state = model.basis.state(latents[:, None])
            torch.testing.assert_close(state, states[:, t], rtol=1e-4, atol=1e-4)
            actions = torch.from_numpy(wanted[:, t]) if t < 7 else None


def test_a_frozen_smoothers_states_stay_what_they_are():
    task = vector_task(horizon=7)
    first, second = vector_episodes(task, 14), vector_episodes(task, 6, seed=7)
    model = make(task=task, dynamics=SMOOTHER)
    model.update(Collected(first))
    states, factor = model.embed(second), own_factor(model)
    model.update(Collected(first, second))
    assert model.moved_in == 1
    assert torch.equal(model.embed(second), states)
    assert digest(own_factor(model)) != digest(factor)


def test_hidden_latents_stay_the_last_entries_of_a_state():
    """Frames tell of the others alone: costs are fitted to them, and white they are apart."""
    task = vector_task(horizon=7)
    episodes = vector_episodes(task, 14)
    model = make(task=task, dynamics=SMOOTHER, held_out=0.01)
    model.update(Collected(episodes))
    latents, states = (part(episodes)[:-1].flatten(0, 1) for part in (model.latents, model.embed))
    assert not model.basis.A[:2, 2:].any()
    assert not model.basis.A[2:, :2].any()
    np.testing.assert_allclose(np.cov(states[:, :2].T), np.eye(2), atol=1e-8)
    assert float(states[:, 2].var()) == pytest.approx(1.0)
    torch.testing.assert_close(latents @ model.basis.A.T + model.basis.b, states)


def test_a_smoother_reconstructs_from_what_all_frames_tell():
    task = vector_task(horizon=7)
    episodes = vector_episodes(task, 14)
    model = make(task=task, dynamics=SMOOTHER)
    model.update(Collected(episodes))
    posterior = model._model.prior.inferred(model._model.encoded(episodes, "cpu"))
    networks = model._model.networks
    scaled = networks.scaled(torch.from_numpy(episodes.frames).flatten(0, 1))
    expected = networks.decoder(posterior.mean.flatten(0, 1).float())
    found = networks.scaled(torch.from_numpy(model.reconstruct(episodes)).flatten(0, 1))
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    assert not torch.allclose(found, networks.reconstruct(scaled), atol=1e-3)


def test_reconstructions_have_the_shape_and_units_of_frames():
    model = make(steps=200, attempts=1, learning_rate=0.01)
    model.update(Collected(FIRST))
    found = model.reconstruct(FIRST)
    assert found.shape == FIRST.frames.shape
    assert found.dtype == FIRST.frames.dtype
    # Two latents of three entries explain most of what a linear map of two can: more than half.
    assert np.square(found - FIRST.frames).mean() < 0.5 * FIRST.frames.var(axis=(0, 1)).mean()
