"""A representation is watched, repaired, fixed or fine-tuned, and resumed with the same bits."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from model_problems import digest, through_a_file, vector_episodes, vector_task

from solar_cli.episodes import Episodes, window_indices
from solar_cli.models import representation, training
from solar_cli.models.priors import LinearDynamics
from solar_cli.models.representation import Representation
from solar_cli.settings.local import Solar
from solar_cli.streams import Streams

TASK = vector_task(horizon=7, window=2)
FIRST = vector_episodes(TASK, 14)


class Stop(Exception):
    pass


class Collected:
    """An environment's side of it: the iteration, and batches of the last ones."""

    def __init__(self, *batches: Episodes) -> None:
        self.batches = batches
        self.iteration = len(batches)

    def recent(self, count: int) -> list[Episodes]:
        return list(self.batches[-count:])


class Scores:
    """Stands for the cost fit: gives what it is told, and keeps the states it is asked about."""

    def __init__(self, *scores: float) -> None:
        self.scores = scores
        self.seen: list[tuple[torch.Tensor, Episodes]] = []

    def __call__(self, z: torch.Tensor, episodes: Episodes) -> float:
        self.seen.append((z, episodes))
        return self.scores[min(len(self.seen), len(self.scores)) - 1]


@pytest.fixture(autouse=True)
def short_and_easily_pleased(monkeypatch):
    """A pulse every second step; only the cost score tells a healthy representation."""
    monkeypatch.setattr(training, "PULSE_STEPS", 2)
    monkeypatch.setattr(representation, "LEAST_EXPLAINED", -math.inf)


def make(score=None, pulse=lambda *_: None, seed=0, task=TASK, **changes) -> Representation:
    layers = ({"kind": "linear", "width": 6},)
    settings = Solar.model_validate(
        {
            "batches": {"initial": 14, "noisy": 6},
            "budget": {"desk": 1, "full": 1},
            "representation": {"latent": 2, "encoder": layers, "decoder": layers},
            "training": {"steps": 4, "segments": 3, "length": 4, **changes},
        }
    )
    return Representation(
        settings,
        task,
        lambda: LinearDynamics(settings.dynamics, 2, task, "cpu"),
        Scores(1.0) if score is None else score,
        Streams(seed),
        "cpu",
        pulse,
    )


def held_out(share=0.15) -> Episodes:
    return FIRST[-max(1, round(share * len(FIRST))) :]


# Watching and repairing


def test_a_dead_representation_is_discarded_and_the_next_one_kept():
    score = Scores(0.1, 0.9)
    model = make(score)
    metrics = model.update(Collected(FIRST))
    assert len(score.seen) == 2
    first, second = (z for z, _ in score.seen)
    kept = model.embed(score.seen[1][1])
    assert torch.equal(kept, second)
    assert not torch.allclose(kept, first)
    assert metrics["discarded_trainings"] == 1.0
    assert metrics["seconds_discarded"] > 0.0
    assert metrics["latent_cost_r2"] == 0.9
    assert metrics["healthy"] == 1.0


def test_a_healthy_representation_is_the_last_that_is_trained():
    score = Scores(0.9)
    metrics = make(score).update(Collected(FIRST))
    assert len(score.seen) == 1
    assert metrics["discarded_trainings"] == metrics["seconds_discarded"] == 0.0


def test_unexplained_frames_are_dead_too(monkeypatch):
    monkeypatch.setattr(representation, "LEAST_EXPLAINED", 1.0)
    score = Scores(1.0)
    metrics = make(score).update(Collected(FIRST))
    assert len(score.seen) == 3
    assert metrics["explained_variance"] < 1.0
    assert metrics["healthy"] == 0.0


def test_of_dead_representations_the_one_of_least_held_out_loss_is_kept():
    seen: dict[int, float] = {}

    def pulse(*_):
        for number, candidate in enumerate(model.state_dict()["candidates"]):
            seen[number] = candidate[0]

    score = Scores(0.0)
    model = make(score, pulse)
    metrics = model.update(Collected(FIRST))
    assert len(score.seen) == 3
    assert metrics["discarded_trainings"] == 2.0
    assert metrics["healthy"] == 0.0
    assert metrics["held_out_loss"] <= min(seen.values())
    losses = [seen[0], seen[1], metrics["held_out_loss"]]
    best = int(np.argmin(losses))
    assert torch.equal(model.embed(score.seen[best][1]), score.seen[best][0])


def test_a_healthy_one_is_kept_whatever_its_loss():
    seen: dict[int, float] = {}

    def pulse(*_):
        for number, candidate in enumerate(model.state_dict()["candidates"]):
            seen[number] = candidate[0]

    # The second attempt is the healthy one, trained so briefly that seeds decide about losses.
    for seed in range(20):
        score = Scores(0.0, 1.0)
        model = make(score, pulse, seed=seed)
        metrics = model.update(Collected(FIRST))
        if metrics["held_out_loss"] > seen[0]:
            break
    else:
        pytest.fail("no seed's second training is worse than its first")
    assert torch.equal(model.embed(score.seen[1][1]), score.seen[1][0])


def test_attempts_are_judged_on_episodes_that_they_did_not_learn_from():
    score, standardised = Scores(0.0), []
    model = make(score, held_out=0.3, attempts=2)
    original = representation.FrameModel.standardise_by
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            representation.FrameModel,
            "standardise_by",
            lambda self, frames: standardised.append(frames) or original(self, frames),
        )
        model.update(Collected(FIRST))
    kept = round(0.3 * 14)
    for _, episodes in score.seen:
        np.testing.assert_array_equal(episodes.frames, FIRST.frames[-kept:])
    for frames in standardised:
        np.testing.assert_array_equal(frames.numpy(), FIRST.frames[:-kept].reshape(-1, 3))


def test_an_active_latent_is_one_whose_mean_carries_its_variance(monkeypatch):
    model = make()
    model.update(Collected(FIRST))
    segments = model._model.posterior(FIRST, "cpu")
    # One latent varies as its variance is, so its mean carries half; the other hardly has any.
    spread = segments.mean.flatten(0, 1).var(dim=0)
    variance = torch.stack([spread[0], 0.01 * spread[1]])
    monkeypatch.setattr(
        model._model,
        "posterior",
        lambda *_: segments._replace(variance=variance.expand_as(segments.variance)),
    )
    assert model._judge(FIRST)["active_latents"] == 1.0


# Weights and seeds


def test_first_weights_depend_on_seed_and_attempt_alone():
    torch.manual_seed(123)
    before = torch.get_rng_state()
    first = digest(make().state_dict())
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(456)
    assert digest(make().state_dict()) == first
    assert digest(make(seed=1).state_dict()) != first
    trained = make(Scores(0.0, 1.0))
    trained.update(Collected(FIRST))
    again = make(Scores(0.0, 1.0))
    again.update(Collected(FIRST))
    assert torch.equal(trained.embed(FIRST), again.embed(FIRST))


# Stopping and going on


def checkpoints(batches: list[Collected], **changes) -> tuple[list[Any], str, list[dict]]:
    """Updates done, state and judged attempts at every pulse; the final digest; all metrics."""
    saved: list[Any] = []

    def pulse(*_):
        saved.append((len(metrics), through_a_file(model.state_dict()), len(score.seen)))

    score = Scores(0.1, 0.2, 0.9, 0.9, 0.9)
    model = make(score, pulse, **changes)
    metrics: list[dict[str, float]] = []
    for batch in batches:
        metrics.append(model.update(batch))
    return saved, digest(model.state_dict()), metrics


def without_seconds(metrics: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in metrics.items() if not name.startswith("seconds_")}


@pytest.mark.parametrize("fine_tune_steps", [0, 4])
def test_an_update_stopped_at_any_pulse_goes_on_with_the_same_bits(fine_tune_steps):
    second = vector_episodes(TASK, 6, seed=7)
    batches = [Collected(FIRST), Collected(FIRST, second)]
    changes = {"fine_tune_steps": fine_tune_steps, "attempts": 3}
    saved, expected, metrics = checkpoints(batches, **changes)
    assert len(saved) == 6 + fine_tune_steps // 2  # three attempts, two of them dead
    for number, state, judged in saved:
        score = Scores(*[0.1, 0.2, 0.9, 0.9, 0.9][judged:])
        resumed = make(score, **changes)
        resumed.load_state_dict(state)
        for batch, before in list(zip(batches, metrics, strict=True))[number:]:
            assert without_seconds(resumed.update(batch)) == without_seconds(before)
        assert digest(resumed.state_dict()) == expected


def test_a_checkpoint_can_be_made_again_before_anything_goes_on():
    saved, _, _ = checkpoints([Collected(FIRST)])
    for _, state, _ in saved:
        fresh = make()
        fresh.load_state_dict(state)
        assert digest(through_a_file(fresh.state_dict())) == digest(state)


# Later iterations


def test_a_frozen_encoder_keeps_its_states_and_learns_its_dynamics():
    model = make(buffer=2)
    batches = [FIRST, *(vector_episodes(TASK, 5, seed=seed) for seed in (1, 2))]
    model.update(Collected(batches[0]))
    assert model.moved
    states, basis = model.embed(FIRST), model.basis
    factor = model.dynamics_prior.factor
    for last in (2, 3):
        model.update(Collected(*batches[:last]))
        assert not model.moved
    assert torch.equal(model.embed(FIRST), states)
    assert digest(list(model.basis)) == digest(list(basis))
    closed = LinearDynamics(model.settings.dynamics, 2, TASK, "cpu")
    closed.condition(model._model.posterior(Episodes.joined(batches[1:]), "cpu"))
    assert digest(list(model.dynamics_prior.factor)) == digest(list(closed.factor))
    assert digest(list(model.dynamics_prior.factor)) != digest(list(factor))


def test_fine_tuning_moves_the_states_within_a_fixed_basis():
    model = make(fine_tune_steps=4)
    model.update(Collected(FIRST))
    states, basis = model.embed(FIRST), model.basis
    metrics = model.update(Collected(FIRST, vector_episodes(TASK, 6, seed=7)))
    assert model.moved
    assert not torch.allclose(model.embed(FIRST), states)
    assert digest(list(model.basis)) == digest(list(basis))
    assert {"elbo_reconstruction", "elbo_kl", "held_out_loss"} <= set(metrics)


def test_metrics_of_an_update_are_finite_numbers():
    for iteration in (1, 2):
        metrics = make().update(Collected(*[FIRST] * iteration))
        assert all(isinstance(value, float) for value in metrics.values())
        assert all(math.isfinite(value) for value in metrics.values())
        assert {"kl_dynamics", "kl_initial", "seconds_model"} <= set(metrics)


# States


def test_states_are_the_basis_of_windows_of_single_frames():
    model = make()
    model.update(Collected(FIRST))
    states = model.embed(FIRST)
    assert states.shape == (14, 8, 4)
    assert states.dtype == torch.float64
    latents = torch.stack([model.encode(FIRST.frames[:, t]) for t in range(8)], dim=1)
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


def test_reconstructions_have_the_shape_and_units_of_frames():
    model = make(steps=200, attempts=1, learning_rate=0.01)
    model.update(Collected(FIRST))
    found = model.reconstruct(FIRST)
    assert found.shape == FIRST.frames.shape
    assert found.dtype == FIRST.frames.dtype
    # Two latents of three entries explain most of what a linear map of two can: more than half.
    assert np.square(found - FIRST.frames).mean() < 0.5 * FIRST.frames.var(axis=(0, 1)).mean()
