"""The video model: pixels are carried by the distances that it says."""

import itertools

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import nn

from solar_cli.errors import UsageError
from solar_cli.models.video import VideoModel
from solar_cli.settings import TaskSettings
from solar_cli.settings.pixel_mpc import Video


def task(window: int = 1, channels: int = 2, side: int = 16) -> TaskSettings:
    seen = {"height": side, "width": side + 4, "channels": channels, "window": window}
    return TaskSettings.model_validate(
        {
            "simulator": "navigation",
            "horizon": 9,
            "observation": seen,
            "action": {"size": 2, "bound": 1.0},
            "exploration": {"std": 0.1},
        }
    )


def model(seed: int = 0, **changes) -> VideoModel:
    torch.manual_seed(seed)
    made = VideoModel(Video(pool=2, layers=3), task(**changes))
    nn.init.normal_(made.background)
    return made


def window(of: VideoModel, count: int, frames: int = 1) -> torch.Tensor:
    return torch.randn(count, frames, *of.shape)


def moving(of: VideoModel, *distances: tuple[float, float]) -> None:
    """Its layers move so far down and across at every step, whatever is seen and done."""
    last = of.motion[-1]
    nn.init.zeros_(last.weight)
    last.bias.data = torch.tensor(distances).flatten()


def frames(of: VideoModel, seen: torch.Tensor, steps: int) -> list[torch.Tensor]:
    actions = torch.zeros(len(seen), 1, steps, 2)
    return [step.frame for step in of.rollout(seen, actions)]


def test_without_motion_the_newest_frame_stays():
    of = model(window=2)
    moving(of, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    seen = window(of, 3, 2)
    for frame in frames(of, seen, 3):
        torch.testing.assert_close(frame, seen[:, -1])


@pytest.mark.parametrize("distance", [(2.0, -1.0), (0.3, 0.8), (-1.6, 0.0), (20.0, 0.0)])
def test_layers_move_as_scipy_shifts_them_over_the_background(distance):
    """All layers that move alike: those of the masks together."""
    of = model()
    moving(of, distance, distance, distance)
    seen = window(of, 2)
    with torch.no_grad():
        masks = of.masks(seen[:, 0]).view(2, 4, *of.shape).softmax(dim=1)
        steps = frames(of, seen, 3)
    background = of.background.detach()
    over = (seen[:, 0] - background)[:, None] * masks
    for number, frame in enumerate(steps, start=1):
        moved = [0, 0, *(number * d for d in distance)]
        shifted = ndimage.shift(
            over[:, 1:].sum(dim=1).numpy(), moved, order=1, mode="grid-constant"
        )
        expected = over[:, 0].numpy() + shifted + background.numpy()
        np.testing.assert_allclose(frame.numpy(), expected, atol=1e-5)


def test_each_layer_moves_by_its_own_distance():
    of = model()
    distances = ((1.0, 0.0), (0.0, -2.0), (0.5, 0.5))
    moving(of, *distances)
    seen = window(of, 1)
    with torch.no_grad():
        masks = of.masks(seen[:, 0]).view(4, *of.shape).softmax(dim=0)
        (found,) = frames(of, seen, 1)
    over = (masks * (seen[0, 0] - of.background.detach())).numpy()
    expected = over[0] + of.background.detach().numpy()
    for layer, distance in zip(over[1:], distances, strict=True):
        expected = expected + ndimage.shift(layer, [0, *distance], order=1, mode="grid-constant")
    np.testing.assert_allclose(found[0].numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("frames_seen", [1, 3])
def test_costs_are_of_windows_of_what_was_predicted(frames_seen):
    of = model(window=frames_seen)
    seen = window(of, 4, frames_seen)
    with torch.no_grad():
        steps = list(of.rollout(seen, torch.randn(4, 1, 5, 2)))
        film = torch.cat([seen, torch.stack([step.frame for step in steps], dim=1)], dim=1)
        for number, step in enumerate(steps, start=1):
            expected = of.cost_of(film[:, number : number + frames_seen])
            torch.testing.assert_close(step.cost, expected)


def test_all_sequences_of_all_episodes_are_one_batch():
    """As each sequence of each episode for itself, and the last action changes the last step."""
    of = model(window=2)
    seen, actions = window(of, 3, 2), torch.randn(3, 4, 5, 2)
    with torch.no_grad():
        together = list(of.rollout(seen, actions))
        for row, (n, s) in enumerate(itertools.product(range(3), range(4))):
            alone = list(of.rollout(seen[n : n + 1], actions[n : n + 1, s : s + 1]))
            for one, every in zip(alone, together, strict=True):
                torch.testing.assert_close(one.frame[0], every.frame[row])
                torch.testing.assert_close(one.cost[0], every.cost[row])
        actions[:, :, -1] += 1.0
        other = list(of.rollout(seen, actions))
    assert all(
        torch.equal(a.frame, b.frame) for a, b in zip(together[:-1], other[:-1], strict=True)
    )
    assert not torch.isclose(together[-1].frame, other[-1].frame).all()


def test_frames_come_back_in_their_units_and_size():
    of = model()
    stored = torch.randint(0, 256, (5, 2, 8, 10), dtype=torch.uint8)
    stored = stored.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
    pooled = of.pooled(stored[None])[0]
    of.scale_by(pooled, torch.randn(5, 2), torch.randn(5))
    scaled = of.scaled(pooled)
    assert float(scaled.mean()) == pytest.approx(0.0, abs=1e-5)
    assert float(scaled.square().mean()) == pytest.approx(1.0, rel=1e-4)
    assert torch.equal(of.as_frames(scaled), stored)


def test_a_pool_that_does_not_fit_is_one_clear_line():
    with pytest.raises(UsageError, match=r"video.pool = 3 .* 16 x 20 pixels"):
        VideoModel(Video(pool=3), task())
