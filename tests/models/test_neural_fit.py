"""The fit of neural models: it learns, keeps the best, holds out what it says, and can stop."""

import numpy as np
import pytest
import torch
from bits import digest, through_a_file

from solar_cli.models import neural_fit
from solar_cli.models.neural import NeuralCost, NeuralDynamics, Sequences
from solar_cli.models.neural_fit import Minibatches, NeuralModel, NeuralTrainer
from solar_cli.pulse import Diverged
from solar_cli.settings.neural import NeuralFit
from solar_cli.streams import Streams

T, z, a = 12, 3, 2
SMALL = NeuralFit(widths=(16,), steps=40, batch=16, unroll=2)


def silent(activity: str, share: float) -> None:
    """A pulse that nobody hears."""


def episodes(count=10, seed=0) -> Sequences:
    """A curved world that comes to rest, which actions push; its cost is a cosine."""
    rng = np.random.default_rng(seed)
    states, actions = np.empty((count, T + 1, z)), rng.normal(size=(count, T, a))
    states[:, 0] = rng.normal(size=(count, z))
    for t in range(T):
        pushed = 0.3 * np.sin(states[:, t, [1, 2, 0]]) + 0.2 * actions[:, t, [0, 1, 0]]
        states[:, t + 1] = 0.7 * states[:, t] + pushed
    return Sequences(
        torch.from_numpy(states).float(),
        torch.from_numpy(actions).float(),
        torch.from_numpy(1 - np.cos(states[:, :-1, 0])).float(),
        torch.ones(count, T, dtype=torch.bool),
    )


def model(settings=SMALL, seed=0, cost=True) -> NeuralModel:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return NeuralModel(
            NeuralDynamics(z, z, a, settings), NeuralCost(z, settings) if cost else None
        )


def fitted(settings=SMALL, batches=None, made=None, pulse=silent):
    made = model(settings) if made is None else made
    trainer = NeuralTrainer(settings, Streams(0), pulse)
    batches = [episodes()] if batches is None else batches
    return made, trainer.fit("x", made, batches, 1, 4)


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looks and pulses every few steps."""
    monkeypatch.setattr(neural_fit, "JUDGED_STEPS", 8)


def test_dynamics_and_costs_of_a_curved_world_are_learned():
    settings = NeuralFit(widths=(32,), steps=800, unroll=2, learning_rate=1e-2)
    made, metrics = fitted(settings, [episodes(60)])
    fresh = episodes(20, seed=9)
    with torch.no_grad():
        rolled = made.dynamics.rolled(fresh.states[:, 0], fresh.actions)
        assert float((rolled - fresh.states[:, 1:]).square().mean().sqrt()) < 0.1
        costs = made.cost.of(fresh.states[:, :-1])
        assert float((costs - fresh.costs).square().mean().sqrt()) < 0.1
    assert min(metrics["one_step_r2"], metrics["horizon_r2"], metrics["cost_r2"]) > 0.95


def test_what_is_kept_is_what_held_out_episodes_like_best(often):
    """Rates that overshoot: later is not better."""
    rough = {"learning_rate": 0.3, "schedule": "constant"}
    settings = SMALL.model_copy(update=rough)
    losses = []
    batch = episodes()
    held_out = batch.some(slice(-1, None))

    def looking(activity, share):
        losses.append(float(made.loss(held_out.segments(*held_out.starts(2), 2)).detach()))

    made = model(settings)
    _, metrics = fitted(settings, [batch], made, looking)
    assert losses[-1] > min(losses)
    assert metrics["held_out_loss"] == pytest.approx(min(losses))
    assert metrics["kept_step"] == 8 * (1 + int(np.argmin(losses)))
    looking("", 1.0)
    assert losses[-1] == pytest.approx(min(losses))


def test_held_out_episodes_teach_nothing():
    """The last of each batch: others in their place leave the parameters as they are."""
    batches = [episodes(10, 0), episodes(10, 1)]
    others = [
        Sequences(
            *(torch.cat([p[:-1], q[-1:]]) for p, q in zip(batch, episodes(10, 5), strict=True))
        )
        for batch in batches
    ]
    first, metrics = fitted(batches=batches)
    second, otherwise = fitted(batches=others)
    assert digest(first.state_dict()) == digest(second.state_dict())
    assert metrics["one_step_r2"] != otherwise["one_step_r2"]
    changed = [episodes(10, 0), episodes(10, 2)]
    assert digest(fitted(batches=changed)[0].state_dict()) != digest(first.state_dict())


def test_scales_are_those_of_the_first_episodes():
    made, _ = fitted()
    before = made.dynamics.change.x_mean.clone()
    fitted(batches=[episodes(10, 7)], made=made)
    torch.testing.assert_close(made.dynamics.change.x_mean, before, rtol=0, atol=0)
    assert float(before.abs().max()) > 0


@pytest.mark.parametrize("unroll", [1, 3])
def test_a_fit_interrupted_at_any_pulse_ends_with_the_same_bits(often, unroll):
    settings = SMALL.model_copy(update={"unroll": unroll, "noise": 0.1, "new": 0.5})
    batches, saved = [episodes(6, 0), episodes(6, 1)], []

    def save(activity, share):
        saved.append(through_a_file({"m": made.state_dict(), "t": trainer.state_dict()}))

    made, trainer = model(settings), NeuralTrainer(settings, Streams(0), save)
    expected = trainer.fit("x", made, batches, 1, 4)
    del expected["seconds_training"]
    assert len(saved) == 5
    for state in saved:
        again, other = model(settings, seed=1), NeuralTrainer(settings, Streams(0), silent)
        again.load_state_dict(state["m"])
        other.load_state_dict(state["t"])
        found = other.fit("x", again, batches, 1, 4)
        del found["seconds_training"]
        assert found == expected
        assert digest(again.state_dict()) == digest(made.state_dict())
    assert trainer.state_dict() == {}


@pytest.mark.parametrize(("new", "expected"), [(0.0, 0), (0.75, 12), (1.0, 16)])
def test_a_share_of_each_batch_is_of_the_planners_episodes(new, expected):
    settings = SMALL.model_copy(update={"new": new})
    seen = Sequences.joined([episodes(6, 0), episodes(2, 1)])
    seen.costs[6:] = 99.0
    draws = Minibatches(seen, 6, 2, 8, settings)
    for step in range(20):
        segment, _ = draws.draw(np.random.default_rng(step))
        assert int((segment.costs[:, 0] == 99.0).sum()) == expected


def test_without_a_share_all_segments_are_alike():
    """Six of eight episodes are of exploration: three quarters of what is drawn."""
    seen = Sequences.joined([episodes(6, 0), episodes(2, 1)])
    seen.costs[6:] = 99.0
    draws = Minibatches(seen, 6, 2, 8, SMALL)
    many = [draws.draw(np.random.default_rng(step))[0].costs[:, 0] for step in range(200)]
    share = float((torch.cat(many) == 99.0).float().mean())
    assert share == pytest.approx(0.25, abs=0.03)  # 3200 draws: a std of .008


def test_a_loss_that_is_no_number_ends_the_fit():
    broken = episodes()
    broken.states[:, 5] = torch.nan
    with pytest.raises(Diverged, match="step 0 of x"):
        fitted(batches=[broken])
    with pytest.raises(Diverged, match="step 40 of x"):
        fitted(SMALL.model_copy(update={"learning_rate": 1e30}))


@pytest.mark.parametrize("share", [0.01, 0.99])
def test_some_episodes_are_always_learned_from_and_some_held_out(share):
    _, metrics = fitted(SMALL.model_copy(update={"held_out": share}))
    assert np.isfinite(metrics["one_step_r2"])


def test_a_fit_that_only_harms_changes_nothing():
    model, _ = fitted()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    harmful = SMALL.model_copy(update={"learning_rate": 30.0, "schedule": "constant"})
    NeuralTrainer(harmful, Streams(1), lambda *_: None).fit("y", model, [episodes()], 1, 3)
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name])
