"""Training of the video model: what clips are, what their errors are, and stopping at any pulse."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from bits import digest, through_a_file
from test_video import model, task
from torch.nn import functional

from solar_cli.episodes import Episodes, window_indices
from solar_cli.models import video_training
from solar_cli.models.video import VideoModel
from solar_cli.models.video_training import ClipData, VideoTrainer, errors
from solar_cli.pulse import Diverged
from solar_cli.settings.pixel_mpc import Video, VideoTraining
from solar_cli.streams import Streams

ALPHA = 0.3


def episodes(count=6, window=1, lengths=None, seed=0) -> Episodes:
    """A square that goes where the action says, by 2 pixels for 0.1; far right is expensive."""
    rng = np.random.default_rng(seed)
    steps = rng.integers(-1, 2, (count, 9, 2))
    places = np.concatenate([rng.integers(6, 9, (count, 1, 2)), 2 * steps], axis=1).cumsum(axis=1)
    places = places.clip(0, [12, 16])
    frames = np.zeros((count, 10, 2, 16, 20), np.uint8)
    for n, t in np.ndindex(count, 10):
        row, column = places[n, t]
        frames[n, t, 0, row : row + 4, column : column + 4] = 200
    costs = 0.1 * places[:, :-1, 1] + ALPHA * np.square(0.1 * steps).sum(axis=-1)
    actions = 0.1 * steps.astype(float)
    return Episodes(frames, actions, actions, costs, window, lengths)


def data(batches, of, horizon=4) -> ClipData:
    return ClipData(batches, horizon, ALPHA, of, "cpu")


@pytest.mark.parametrize("window", [1, 3])
def test_clips_are_what_the_episodes_hold(window):
    lengths = np.array([9, 2, 5, 9, 1, 9])
    every, of = episodes(6, window, lengths), model(window=window)
    rows, steps = every.live_steps.nonzero()
    clips = data([every[:2], every[2:]], of).at(rows, steps)
    pooled = functional.avg_pool2d(torch.from_numpy(every.frames).float().flatten(0, 1), 2)
    pooled = pooled.view(6, 10, 2, 8, 10)
    known = ALPHA * np.square(every.actions).sum(axis=-1)
    for i, (n, t) in enumerate(zip(rows, steps, strict=True)):
        before = pooled[n, window_indices(9, window)[t]]
        assert torch.equal(clips.frames[i, :window], before)
        for h in range(1, 5):
            assert clips.live_frames[i, h - 1] == (t + h <= lengths[n])
            if clips.live_frames[i, h - 1]:
                assert torch.equal(clips.frames[i, window + h - 1], pooled[n, t + h])
                np.testing.assert_allclose(clips.actions[i, h - 1], every.actions[n, t + h - 1])
        for h in range(5):
            assert clips.live_costs[i, h] == (t + h < lengths[n])
            if clips.live_costs[i, h]:
                expected = every.costs[n, t + h] - known[n, t + h]
                assert float(clips.costs[i, h]) == pytest.approx(expected, abs=1e-6)


def test_half_of_the_clips_are_of_the_newest_batch():
    old, new = episodes(30), episodes(2, seed=1)
    new.actions[:] = 7.0
    clips = data([old, new], model()).drawn(400, np.random.default_rng(0))
    share = float((clips.actions[:, 0, 0] == 7.0).float().mean())
    assert share == pytest.approx(0.5 + 0.5 * 2 / 32, abs=5 * math.sqrt(0.25 / 400))


def test_a_model_that_copies_has_the_errors_of_copying():
    of = model()
    torch.nn.init.zeros_(of.motion[-1].weight)
    torch.nn.init.zeros_(of.motion[-1].bias)
    clips = data([episodes()], of).drawn(20, np.random.default_rng(0))
    with torch.no_grad():
        found = errors(of, clips)
    for wrong, still in zip(found.frames, found.still, strict=True):
        torch.testing.assert_close(wrong, still)
    assert (found.still[0] > 0).all()


def test_what_was_not_lived_does_not_count():
    lengths = np.array([3, 2, 5])
    one, of = episodes(3, 1, lengths), model()
    other = Episodes(one.frames.copy(), one.actions, one.actions, one.costs.copy(), 1, lengths)
    for n, length in enumerate(lengths):
        other.frames[n, length + 1 :] = 255
        other.costs[n, length:] = 1e3
    with torch.no_grad():
        found = [
            errors(of, data([batch], of).drawn(30, np.random.default_rng(0)))
            for batch in (one, other)
        ]
    assert digest(tuple(found[0])) == digest(tuple(found[1]))


def trained(steps, pulse=lambda *_: None, batches=None) -> SimpleNamespace:
    of = VideoModel(Video(pool=2, layers=2, width=16), task())
    clips = data(batches or [episodes(20)], of)
    of.scale_by(
        clips.frames[:, :-1].flatten(0, 1), *(x.flatten(0, 1) for x in (clips.actions, clips.costs))
    )
    settings = VideoTraining(steps=steps, clips=16, learning_rate=1e-2)
    trainer = VideoTrainer(settings, Streams(0), pulse)
    return SimpleNamespace(model=of, data=clips, trainer=trainer)


def losses(metrics: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in metrics.items() if not name.startswith("seconds_")}


def test_it_learns_where_things_go_and_what_they_cost():
    torch.manual_seed(0)
    one = trained(150)
    one.trainer.fit("a", one.model, one.data, first=True)
    held_out = data([episodes(20, seed=1)], one.model).drawn(100, np.random.default_rng(0))
    with torch.no_grad():
        found = errors(one.model, held_out)
    assert float(found.frames[0].sum() / found.still[0].sum()) < 0.3
    assert float(found.costs) < 0.3


def test_training_stopped_at_any_pulse_goes_on_with_the_same_bits(monkeypatch):
    monkeypatch.setattr(video_training, "PULSE_STEPS", 3)
    saved = []

    def save(*_):
        saved.append(through_a_file([whole.model.state_dict(), whole.trainer.state_dict()]))

    torch.manual_seed(0)
    whole = trained(9, save)
    expected = whole.trainer.fit("a", whole.model, whole.data, first=True)
    assert len(saved) == 3
    for parameters, running in saved:
        resumed = trained(9)
        resumed.model.load_state_dict(parameters)
        resumed.trainer.load_state_dict(running)
        assert resumed.trainer.under_way
        assert digest(resumed.trainer.state_dict()) == digest(running)
        found = resumed.trainer.fit("a", resumed.model, resumed.data, first=True)
        assert losses(found) == losses(expected)
        assert digest(resumed.model.state_dict()) == digest(whole.model.state_dict())
        assert not resumed.trainer.under_way


def test_a_loss_that_is_not_finite_is_a_divergence():
    torch.manual_seed(0)
    one = trained(20)
    one.data.costs[:] = math.nan
    with pytest.raises(Diverged, match="step 20 of a"):
        one.trainer.fit("a", one.model, one.data, first=True)
