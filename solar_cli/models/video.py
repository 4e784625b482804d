"""Action-conditioned prediction of frames and of what they cost.

The newest frame seen is parted by soft masks in layers. Layer 0 stays; a step moves each other one
by a distance that a network reads off the window of frames and the action, and a learned background
shows where nothing is left. So pixels are carried, not drawn anew: a blob that moves stays a blob.
What is predicted goes into the window, for the next step and for the cost.

Finn et al. 2016 (CDNA) move the frame before, and mask what comes of it: moved again and again, a
frame blurs, and every step of every action sequence pays for new masks. Here the distances add up,
every frame is the seen one moved once, and its masks are made once a plan. The price: a layer moves
as a whole, so that what turns does so in pieces, and layers that cross shine through each other.

Axes: N episodes or clips, S action sequences of each, H steps ahead, W frames of a window, K layers
that move, C channels and h x w pooled pixels of a frame, f features of one, a entries of an action.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from solar_cli.errors import UsageError
from solar_cli.models.networks import build, perceptron
from solar_cli.settings import TaskSettings
from solar_cli.settings.pixel_mpc import Video

LEAST_SCALE = 1e-6
CHUNK = 512  # frames in floating point at once: what a core's cache holds


class Step(NamedTuple):
    """One step ahead."""

    frame: Float[Tensor, "M C h w"]
    """scaled, of M = N S sequences"""
    cost: Float[Tensor, " M"]
    """of that frame, without what its action costs"""


class VideoModel(nn.Module):
    """Networks and scales."""

    frame_mean: Tensor
    frame_scale: Tensor
    action_scale: Tensor
    cost_mean: Tensor
    cost_scale: Tensor

    def __init__(self, settings: Video, task: TaskSettings) -> None:
        super().__init__()
        self.settings = settings
        seen, size = task.observation, task.action.size
        if seen.height % settings.pool or seen.width % settings.pool:
            raise UsageError(
                f"video.pool = {settings.pool} does not divide a frame of {seen.height} x "
                f"{seen.width} pixels: choose a divisor of both"
            )
        shape = (seen.channels, seen.height // settings.pool, seen.width // settings.pool)
        self.shape = shape
        self.features, after = build(settings.features, shape)
        if len(after) > 1:
            self.features.append(nn.Flatten())
        seen_features = seen.window * math.prod(after)
        hidden, layers = settings.width, settings.layers
        self.masks = nn.Sequential(
            nn.Conv2d(seen.window * shape[0], settings.mask_channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(settings.mask_channels, settings.mask_channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(settings.mask_channels, (1 + layers) * shape[0], 1),
        )
        self.motion = perceptron(seen_features + size, (hidden, hidden), 2 * layers)
        self.cost = perceptron(seen_features, (hidden, hidden), 1)
        self.background = nn.Parameter(torch.zeros(shape))
        for name, buffer in (
            ("frame_mean", torch.zeros(shape)),
            ("frame_scale", torch.ones(())),
            ("action_scale", torch.ones(size)),
            ("cost_mean", torch.zeros(())),
            ("cost_scale", torch.ones(())),
        ):
            self.register_buffer(name, buffer)
        rows, columns = (torch.arange(side, dtype=torch.float32) for side in shape[1:])
        self.register_buffer("_down", rows - rows[:, None], persistent=False)
        self.register_buffer("_across", columns - columns[:, None], persistent=False)
        for parameter in self.parameters():
            if parameter.ndim == 4:  # channels last: twice as fast on a CPU
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)

    def scale_by(
        self,
        frames: Float[Tensor, "n C h w"],
        actions: Float[Tensor, "n a"],
        costs: Float[Tensor, " n"],
    ) -> None:
        """Take means and deviations from live steps; frames are pooled."""
        self.frame_mean.copy_(frames.mean(dim=0, dtype=torch.float32))
        parts = torch.split(frames, CHUNK)
        chunks = [(part - self.frame_mean).square().mean(dim=0) for part in parts]
        spread = torch.stack(chunks).mean().sqrt()
        self.frame_scale.copy_(spread.clamp_min(LEAST_SCALE))
        self.action_scale.copy_(actions.square().mean(dim=0).sqrt().clamp_min(LEAST_SCALE))
        self.cost_mean.copy_(costs.mean())
        self.cost_scale.copy_(costs.std(correction=0).clamp_min(LEAST_SCALE))

    def pooled(self, frames: Tensor) -> Float[Tensor, "*n C h w"]:
        """Means of blocks of pixels of frames as stored, uint8 (..., C, H, W)."""
        flat = frames.reshape(-1, *frames.shape[-3:]).float()
        means = functional.avg_pool2d(flat, self.settings.pool)
        return means.view(*frames.shape[:-3], *self.shape)

    def scaled(self, pooled: Float[Tensor, "*n C h w"]) -> Float[Tensor, "*n C h w"]:
        """As the networks see them: around the mean frame."""
        return (pooled - self.frame_mean) / self.frame_scale

    def as_frames(self, scaled: Float[Tensor, "n C h w"]) -> Tensor:
        """Scaled frames in stored units and at full size."""
        frames = (scaled * self.frame_scale + self.frame_mean).round().clamp(0, 255)
        return functional.interpolate(frames, scale_factor=self.settings.pool).to(torch.uint8)

    def rollout(
        self, window: Float[Tensor, "N W C h w"], actions: Float[Tensor, "N S H a"]
    ) -> Iterator[Step]:
        """Steps 1 to H after the last of the scaled frames of a window, the newest one last."""
        samples, horizon = actions.shape[1:3]
        each = actions.flatten(0, 1) / self.action_scale
        seen = self._read(window.flatten(0, 1)).view(*window.shape[:2], -1)
        seen = seen.repeat_interleave(samples, dim=0)
        still, moving = self._parted(window)
        moved = window.new_zeros(len(seen), self.settings.layers, 2)
        for h in range(horizon):
            told = torch.cat([seen.flatten(1), each[:, h]], dim=1)
            moved = moved + self.motion(told).view_as(moved)
            frame = self._shifted(still, moving, moved)
            seen = torch.cat([seen[:, 1:], self._read(frame)[:, None]], dim=1)
            yield Step(frame, self._priced(seen))

    def cost_of(self, window: Float[Tensor, "N W C h w"]) -> Float[Tensor, " N"]:
        """What the newest frame of each window costs, without its action."""
        return self._priced(self._read(window.flatten(0, 1)).view(*window.shape[:2], -1))

    def _read(self, frames: Float[Tensor, "n C h w"]) -> Float[Tensor, "n f"]:
        features: Tensor = self.features(frames)
        return features

    def _priced(self, seen: Float[Tensor, "n W f"]) -> Float[Tensor, " n"]:
        costs: Tensor = self.cost(seen.flatten(1))[:, 0] * self.cost_scale + self.cost_mean
        return costs

    def _parted(
        self, window: Float[Tensor, "N W C h w"]
    ) -> tuple[Float[Tensor, "N h Cw"], Float[Tensor, "K N h Cw"]]:
        """Layers of the newest frame over the background, rows first: what stays, and the rest."""
        count, channels = len(window), self.shape[0]
        logits = self.masks(window.flatten(1, 2)).view(count, -1, *self.shape)
        layers = logits.softmax(dim=1) * (window[:, -1] - self.background)[:, None]
        rows = layers.permute(1, 0, 3, 2, 4).reshape(
            -1, count, self.shape[1], channels * self.shape[2]
        )
        return rows[0], rows[1:]

    def _shifted(
        self,
        still: Float[Tensor, "N h Cw"],
        moving: Float[Tensor, "K N h Cw"],
        moved: Float[Tensor, "M K 2"],
    ) -> Float[Tensor, "M C h w"]:
        """The layers, each moved down and across, on the background.

        A shift is a product with a matrix of hat functions on either side: bilinear interpolation.
        """
        channels, height, width = self.shape
        count, each = len(still), len(moved)
        rows = still.view(count, 1, height * channels, width)
        frame = rows.expand(-1, each // count, -1, -1).reshape(each, height * channels, width)
        down, across = moved.permute(2, 1, 0)[..., None, None]
        down = (1 - (self._down.mT - down).abs()).clamp_min(0)  # (K, M, h, h): to, from
        across = (1 - (self._across - across).abs()).clamp_min(0)  # (K, M, w, w): from, to
        for k, layer in enumerate(moving):
            vertical = torch.bmm(down[k].reshape(count, -1, height), layer)
            frame = torch.baddbmm(frame, vertical.view(each, -1, width), across[k])
        image = frame.view(each, height, channels, width).transpose(1, 2)
        return image + self.background
