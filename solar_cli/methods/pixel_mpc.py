"""The pixel-space model (after Finn and Levine 2017): video prediction, a cost network, and MPC.

A network predicts the next frames from those seen and the actions, another one what they cost; at
every step the cross-entropy method finds actions whose predicted frames cost least.

The paper says no more of it than that. Finn and Levine predict with a recurrent convolutional
network that moves its last prediction, and bring marked pixels to where a person wants them; as the
paper says, here a cost is learned instead. How ours moves pixels, and why, is in `models/video.py`.
Training looks as far ahead as plans do.

Axes: N episodes, S action sequences, H steps ahead, P actions of a plan, a entries of an action.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from solar_cli.control.exploration import Exploration
from solar_cli.control.latent_policy import Followed
from solar_cli.control.planning import Search, cross_entropy
from solar_cli.control.planning_policy import Acting, PlanningPolicy
from solar_cli.episodes import Episodes, Evaluation, Policy
from solar_cli.experience import Experience
from solar_cli.methods import Learner
from solar_cli.models.video import CHUNK, VideoModel
from solar_cli.models.video_training import ClipData, VideoTrainer, errors
from solar_cli.pulse import Diverged, Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.pixel_mpc import PixelMpc as PixelMpcSettings
from solar_cli.streams import Streams

Floats = NDArray[np.float64]
JUDGED_CLIPS = 300
"""of an evaluation, to diagnose the model with"""


class PixelPlanner:
    """Plans from pooled windows of frames, anew at every step, from the plan before."""

    def __init__(
        self, settings: PixelMpcSettings, task: TaskSettings, model: VideoModel, streams: Streams
    ) -> None:
        planner, std = settings.planner, task.exploration.std
        self.settings, self.task, self.model, self.streams = planner, task, model, streams
        self.actions = -(-planner.horizon // planner.repeat)
        self.search = Search(
            planner.iterations,
            planner.elites,
            task.action.bound,
            planner.std * std,
            planner.least_std * std,
        )

    def see(
        self, observations: NDArray[Any], t: int, state: Acting
    ) -> tuple[Float[Tensor, "N W C h w"], Followed]:
        """The frames of now, as the model sees them; nothing is carried."""
        frames = torch.from_numpy(np.ascontiguousarray(observations))
        pooled = self.model.pooled(frames.to(self.model.frame_mean.device))
        return self.model.scaled(pooled), state.followed

    def __call__(
        self, window: Float[Tensor, "N W C h w"], t: int, before: Float[Tensor, "N P a"] | None
    ) -> Float[Tensor, "N P a"]:
        """As `Planner`: the cross-entropy method, from the plan of the step before."""
        shape = (self.actions, self.task.action.size)
        mean = window.new_zeros(len(window), *shape) if before is None else self.later(before)

        def normal(iteration: int) -> Float[Tensor, "S P a"]:
            draws = self.streams.generator("plan", t, iteration)
            samples = draws.standard_normal((self.settings.samples, *shape), dtype=np.float32)
            return torch.from_numpy(samples).to(window)

        return cross_entropy(
            lambda actions: self.forecast(window, actions), mean, self.search, normal
        )

    def forecast(
        self, window: Float[Tensor, "N W C h w"], actions: Float[Tensor, "N S P a"]
    ) -> Float[Tensor, "N S"]:
        """Costs of the H steps ahead, in groups of episodes that fit a cache."""
        held = actions.repeat_interleave(self.settings.repeat, dim=2)[:, :, : self.settings.horizon]
        group = max(1, CHUNK // actions.shape[1])
        totals = []
        parts = zip(torch.split(window, group), torch.split(held, group), strict=True)
        for some, each in parts:
            steps = [step.cost for step in self.model.rollout(some, each)]
            totals.append(torch.stack(steps).sum(dim=0).view(each.shape[:2]))
        known = self.task.action_cost * held.square().sum(dim=(2, 3))
        return (torch.cat(totals) + known).nan_to_num(torch.inf)

    def later(self, plan: Float[Tensor, "N P a"]) -> Float[Tensor, "N P a"]:
        """The plan a step later: each action is held for less, and for some of the next one's."""
        following = torch.cat([plan[:, 1:], plan[:, -1:]], dim=1)
        return plan + (following - plan) / self.settings.repeat


class PixelMpc(Learner):
    """The pixel-space model on one cell."""

    def __init__(
        self,
        settings: PixelMpcSettings,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.settings, self.task, self.streams = settings, task, streams
        self.device = device
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(streams.seed63("weights"))
            model = VideoModel(settings.video, task)
        self.model = model.to(device)
        self.trainer = VideoTrainer(settings.training, streams.under("video"), pulse)
        self.trained = False

    @property
    def policy(self) -> Policy:
        """The planner, or before anything is known the card's exploration noise."""
        if not self.trained:
            return Exploration(self.task)
        streams, exploration = self.streams.under("planning"), self.task.exploration
        planner = PixelPlanner(self.settings, self.task, self.model, streams)
        noise = self.settings.planner.noise * exploration.std
        return PlanningPolicy(planner.see, planner, noise, exploration.smoothing, self.task)

    def iterate(self, experience: Experience) -> dict[str, float]:
        """Collect with the planner, and train on all episodes so far."""
        settings, first = self.settings, experience.iteration == 1
        count = settings.initial if first else settings.episodes
        collected = experience.collect(self.policy, count)
        if not np.isfinite(collected.costs).all():
            raise Diverged(f"a cost of iteration {experience.iteration} is not finite")
        data = self.clips(experience.batch(name) for name in experience.batches())
        if first and not self.trainer.under_way:
            live = tuple(torch.from_numpy(part).to(self.device) for part in data.live)
            self.model.scale_by(data.frames[live], data.actions[live], data.costs[live])
        name = f"iteration {experience.iteration}"
        losses = self.trainer.fit(name, self.model, data, first=first)
        self.trained = True
        return losses

    def clips(self, batches: Iterable[Episodes]) -> ClipData:
        """Clips as far as a plan looks ahead."""
        horizon = min(self.settings.planner.horizon, self.task.horizon)
        return ClipData(batches, horizon, self.task.action_cost, self.model, self.device)

    def state_dict(self) -> dict[str, Any]:
        """The networks, and a training under way."""
        return {
            "model": {name: value.clone() for name, value in self.model.state_dict().items()},
            "trainer": self.trainer.state_dict(),
            "trained": self.trained,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self.model.load_state_dict(state["model"])
        self.trainer.load_state_dict(state["trainer"])
        self.trained = state["trained"]

    @torch.no_grad()
    def diagnose(self, evaluation: Evaluation) -> dict[str, float]:
        """Errors of frames 1 and H steps ahead, over those of copying, and R2 of their costs."""
        if not self.trained:
            return {}
        data = self.clips([evaluation.episodes])
        found = errors(self.model, data.drawn(JUDGED_CLIPS, self.streams.generator("judging")))
        ratio = found.frames[0] / found.still[0].clamp_min(1e-6)
        return {
            "one_step_frame_error": float(ratio[0]),
            "horizon_frame_error": float(ratio[-1]),
            "cost_r2": 1 - float(found.costs),
        }

    @torch.no_grad()
    def foresee(self, episodes: Episodes) -> NDArray[Any] | None:
        """As `Foreseeing.foresee`, as far as a plan looks ahead."""
        if not self.trained:
            return None
        every = np.arange(len(episodes))
        clips = self.clips([episodes]).at(every, np.zeros_like(every))
        window = self.model.scaled(clips.frames[:, : episodes.window])
        steps = self.model.rollout(window, clips.actions[:, None])
        frames = [self.model.as_frames(step.frame) for step in steps]
        return torch.stack(frames, dim=1).cpu().numpy()
