"""Training of the video model on clips of episodes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from solar_cli.episodes import Episodes
from solar_cli.models.descent import Descent
from solar_cli.models.video import VideoModel
from solar_cli.pulse import Pulse
from solar_cli.settings.pixel_mpc import VideoTraining
from solar_cli.streams import Streams

PULSE_STEPS = 20
POOLINGS = (1, 2, 4)
"""Errors of pooled frames count too, so that what is drawn beside its place is drawn nearer."""


class Clips(NamedTuple):
    """Windows of frames, and what followed."""

    frames: Float[Tensor, "N WH C h w"]
    """pooled: a window, its newest frame at W-1, and the next H"""
    actions: Float[Tensor, "N H a"]
    costs: Float[Tensor, "N H1"]
    """of the state alone, at the window's newest frame and the next H"""
    live_frames: Bool[Tensor, "N H"]
    """whether the episode had each of the next frames"""
    live_costs: Bool[Tensor, "N H1"]


class Errors(NamedTuple):
    """Squared errors of predictions, summed over live ones, and what they are measured against."""

    frames: tuple[Float[Tensor, " H"], ...]
    """of each step ahead, one for each pooling"""
    still: tuple[Float[Tensor, " H"], ...]
    """of the newest frame seen, taken for a prediction"""
    costs: Float[Tensor, ""]
    """mean, over the variance of costs"""


class ClipData:
    """Batches of episodes on the device, pooled as they come; clips start at any live step."""

    def __init__(
        self,
        batches: Iterable[Episodes],
        horizon: int,
        action_cost: float,
        model: VideoModel,
        device: str,
    ) -> None:
        self.horizon, self.device = horizon, device
        frames, actions, costs, lengths = [], [], [], []
        for episodes in batches:
            self.window, self.newest = episodes.window, len(episodes)
            # Half floats: of many episodes the frames are what fills the memory.
            seen = torch.from_numpy(episodes.frames).to(device)
            frames.append(torch.stack([model.pooled(one).half() for one in seen]))
            actions.append(torch.from_numpy(episodes.actions).float())
            known = action_cost * np.square(episodes.actions).sum(axis=-1)
            costs.append(torch.from_numpy(episodes.costs - known).float())
            lengths.append(episodes.lengths)
        self.frames = torch.cat(frames)
        self.actions, self.costs = (torch.cat(part).to(device) for part in (actions, costs))
        self.lengths = np.concatenate(lengths)
        live = np.arange(self.actions.shape[1]) < self.lengths[:, None]
        self.live = np.nonzero(live)
        """episodes and steps that were lived"""

    def drawn(self, count: int, stream: np.random.Generator) -> Clips:
        """Clips at random live steps, half of them from the newest batch of several."""
        rows, steps = self.live
        chosen = stream.integers(len(rows), size=count)
        if first := int(np.searchsorted(rows, len(self.lengths) - self.newest)):
            chosen[: count // 2] = stream.integers(first, len(rows), size=count // 2)
        return self.at(rows[chosen], steps[chosen])

    def at(self, rows: NDArray[np.int64], steps: NDArray[np.int64]) -> Clips:
        """Those of episodes ``rows`` whose windows end at ``steps``; what was not lived is zero."""
        window, horizon = self.window, self.actions.shape[1]
        times = steps[:, None] + np.arange(1 - window, self.horizon + 1)
        lengths = self.lengths[rows, None]
        ahead = times[:, window - 1 :]

        def taken(values: Tensor, when: NDArray[np.int64], last: int) -> Tensor:
            index = (torch.from_numpy(part) for part in (rows[:, None], when.clip(0, last)))
            return values[tuple(part.to(self.device) for part in index)]

        costs = torch.from_numpy(ahead < lengths).to(self.device)
        return Clips(
            taken(self.frames, times, horizon).float(),
            taken(self.actions, ahead[:, :-1], horizon - 1) * costs[:, :-1, None],
            taken(self.costs, ahead, horizon - 1),
            costs[:, :-1],
            costs,
        )


def errors(model: VideoModel, clips: Clips) -> Errors:
    """Of the H frames that follow each clip's window, and of costs of frames seen and predicted."""
    scaled = model.scaled(clips.frames)
    window = scaled[:, : scaled.shape[1] - clips.actions.shape[1]]
    steps = list(model.rollout(window, clips.actions[:, None]))
    predicted = torch.stack([step.frame for step in steps], dim=1)
    live = clips.live_frames[:, :, None, None, None]
    wrong = (predicted - scaled[:, window.shape[1] :]) * live
    change = (window[:, -1:] - scaled[:, window.shape[1] :]) * live
    costs = torch.stack([model.cost_of(window), *(step.cost for step in steps)], dim=1)
    off = (costs - clips.costs)[clips.live_costs] / model.cost_scale
    return Errors(
        tuple(pooled_error(wrong, side) for side in POOLINGS),
        tuple(pooled_error(change, side) for side in POOLINGS),
        off.square().mean(),
    )


def pooled_error(residual: Float[Tensor, "N H C h w"], side: int) -> Float[Tensor, " H"]:
    """Sums of squares after pooling, for each step ahead."""
    pooled = functional.avg_pool2d(residual.flatten(0, 1), side)
    return pooled.square().sum(dim=(1, 2, 3)).view(residual.shape[:2]).sum(dim=0)


class VideoTrainer(Descent):
    """Descent on the error of frames, over that of copying the last one seen, and that of costs."""

    def __init__(self, settings: VideoTraining, streams: Streams, pulse: Pulse) -> None:
        super().__init__("training the video model", PULSE_STEPS, pulse)
        self.settings, self.streams = settings, streams

    def fit(self, name: str, model: VideoModel, data: ClipData, *, first: bool) -> dict[str, float]:
        """Train; the mean errors of the last pulse's steps.

        ``name`` keys the run's random draws; a run of that name that was interrupted goes on.
        """
        settings = self.settings
        steps = settings.steps if first else settings.later_steps
        highest = settings.learning_rate if first else settings.later_rate
        optimiser = torch.optim.Adam(model.parameters(), lr=highest, fused=True)

        def rate(share: float) -> float:
            return highest * 0.5 * (1 + math.cos(math.pi * share))

        for step in self.steps(name, optimiser, steps, rate, errors=(0.0, 0.0)):
            draws = self.streams.generator(name, step.number)
            found = errors(model, data.drawn(settings.clips, draws))
            pairs = zip(found.frames, found.still, strict=True)
            ratios = [wrong.sum() / still.sum().clamp_min(1e-6) for wrong, still in pairs]
            frames = torch.stack(ratios).mean()
            self.descend(frames + found.costs, settings.clip)
            if step.pausing:
                self.record["errors"] = (float(frames.detach()), float(found.costs.detach()))
        record = self.end()
        losses = dict(zip(("loss_frames", "loss_costs"), record["errors"], strict=True))
        return {**losses, "seconds_training": record["seconds"]}
