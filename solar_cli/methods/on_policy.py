"""What PPO and TRPO share: rollouts of whole episodes for learners of Stable-Baselines3.

The networks, the buffer, its advantages and the update are theirs (Raffin et al. 2021); episodes
are collected as for every other method. An iteration is what happens between two evaluations:
one rollout and one update, again and again; evaluations are evenly spaced on a logarithmic axis.

* The reward is minus the cost, times a scale of the card.
* The horizon cuts an episode off, it does not end it: the last reward has the discounted value of
  the last window added, as Stable-Baselines3 does where a time limit truncates.
* Of an episode that is over before, only live steps are learned from; what the task says the rest
  of the time costs is part of the last of them, discounted.

Axes: N episodes of a rollout, T steps, a entries of an action, n live steps.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from solar_cli.control.actor import Actor, stacked
from solar_cli.envs.spaces import observation_space
from solar_cli.episodes import Episodes, window_indices
from solar_cli.experience import Experience
from solar_cli.methods import Learner
from solar_cli.models.actor_critic import ActorCriticOfLayers
from solar_cli.pulse import Diverged, Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.on_policy import OnPolicy
from solar_cli.streams import Streams

LEAST_RATE = 0.05
"""of the first learning rate: what is left when the card's horizon is over"""
LOGGED = {
    "approx_kl": "policy_kl",
    "kl_divergence_loss": "policy_kl",
    "clip_fraction": "clip_fraction",
    "entropy_loss": "minus_entropy",
    "explained_variance": "explained_variance",
    "is_line_search_success": "line_search_success",
    "learning_rate": "learning_rate",
    "value_loss": "value_loss",
}
"""what Stable-Baselines3 logs of an update -> metric"""


class OnPolicyLearner(Learner, ABC):
    """A learner of Stable-Baselines3 on one cell. A method gives `algorithm`."""

    def __init__(
        self,
        settings: OnPolicy,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.settings, self.task, self.streams, self.pulse = settings, task, streams, pulse
        with seeded(streams.under("weights")):
            self.model = self._model(device)
        self.rollouts = 0  # so far
        self.sums: dict[str, float] = {}  # of metrics, over the rollouts of this iteration

    @abstractmethod
    def algorithm(self, **shared: Any) -> OnPolicyAlgorithm:
        """The learner, not yet set up, with what it ``shared`` with others."""

    def _model(self, device: str) -> OnPolicyAlgorithm:
        settings = self.settings
        model = self.algorithm(
            policy=ActorCriticOfLayers,
            env=None,
            learning_rate=lambda left: settings.learning_rate * max(left, LEAST_RATE),
            n_steps=self.task.horizon,
            batch_size=settings.minibatch,
            gamma=settings.discount,
            gae_lambda=settings.gae_lambda,
            policy_kwargs={"settings": settings.network},
            device=device,
            _init_setup_model=False,
        )
        # Without an environment, as when Stable-Baselines3 loads a model from a file.
        model.observation_space = observation_space(self.task)
        model.action_space = spaces.Box(-1.0, 1.0, (self.task.action.size,), np.float32)
        model.n_envs = settings.rollout
        model.set_logger(Logger(folder=None, output_formats=[]))
        model._setup_model()
        return model

    @property
    def network(self) -> ActorCriticOfLayers:
        """Policy and value."""
        found = self.model.policy
        assert isinstance(found, ActorCriticOfLayers)
        return found

    @property
    def policy(self) -> Actor:
        """The newest policy."""
        return Actor(self.network, self.task)

    def iterate(self, experience: Experience) -> dict[str, float]:
        """Rollouts and updates up to the next evaluation; means of what the updates say."""
        done = evaluated_after(experience.iteration - 1, self.settings.evaluations)
        until = evaluated_after(experience.iteration, self.settings.evaluations)
        while self.rollouts < until:
            experience.resume_at(self.rollouts - done)
            actor = self.policy
            episodes = experience.collect(actor, self.settings.rollout, kept=False)
            if not np.isfinite(episodes.costs).all():
                raise Diverged(f"a cost of iteration {experience.iteration} is not finite")
            if self.rollouts == 0 and self.network.standardises:
                # Another network than the one that acted: it learns from the next rollout on.
                self.network.standardise_by(windows(episodes)[episodes.live_steps])
            else:
                began = time.perf_counter()
                self._learn(episodes, actor)
                seconds = time.perf_counter() - began
                self.sums["seconds_training"] = self.sums.get("seconds_training", 0.0) + seconds
            self.rollouts += 1
            self.pulse("learning", (self.rollouts - done) / (until - done))
        sums, self.sums = self.sums, {}
        seconds = sums.pop("seconds_training", 0.0)
        return {**{k: v / (until - done) for k, v in sums.items()}, "seconds_training": seconds}

    def _learn(self, episodes: Episodes, actor: Actor) -> None:
        """One update."""
        model, settings = self.model, self.settings
        model.rollout_buffer = self.buffer(episodes, actor)
        collected = (self.rollouts + 1) * settings.rollout
        model._update_current_progress_remaining(collected, settings.horizon)
        try:
            with seeded(self.streams.under("update", self.rollouts)):
                model.train()
        except ValueError as error:  # how torch's distributions refuse what is no number
            if self._finite():
                raise
            raise Diverged(
                f"update {self.rollouts + 1}: an action's mean or std is not finite; smaller steps "
                "may help, or a reward_scale that makes returns small"
            ) from error
        if not self._finite():
            raise Diverged(f"the policy after update {self.rollouts + 1} is not finite")
        logged = model.logger.name_to_value
        said = {LOGGED.get(name.removeprefix("train/")): value for name, value in logged.items()}
        stds = self.network.log_std.detach().exp() * self.task.action.bound
        said["policy_std"] = float(stds.mean())
        for metric, value in said.items():
            if metric is not None:
                self.sums[metric] = self.sums.get(metric, 0.0) + float(value)

    def _finite(self) -> bool:
        stds = self.network.log_std.exp()  # of a finite log it may be zero or infinite
        numbers = [*self.network.parameters(), stds, 1 / stds]
        return all(bool(torch.isfinite(one).all()) for one in numbers)

    def buffer(self, episodes: Episodes, actor: Actor) -> RolloutBuffer:
        """The live steps of a rollout, episode by episode, with their advantages."""
        model, taken, live = self.model, actor.taken(), episodes.live_steps
        buffer = RolloutBuffer(
            self.task.horizon,
            spaces.Box(0, 1, (1,)),  # what was seen is laid in below, without its steps' copies
            model.action_space,
            model.device,
            model.gae_lambda,
            model.gamma,
            len(episodes),
        )
        buffer.rewards[:] = self._rewards(episodes, actor).T
        buffer.values[:] = taken.values.T
        # Episodes stand side by side in it; what is behind an end must not leak into it.
        ends = np.arange(self.task.horizon) == episodes.lengths[:, None]
        buffer.episode_starts[:] = ends.T
        over = np.ones(len(episodes))
        buffer.compute_returns_and_advantage(torch.zeros(len(episodes)), over)
        for name in ("values", "advantages", "returns"):
            setattr(buffer, name, getattr(buffer, name).T[live][:, None])
        buffer.log_probs = taken.log_probs[live][:, None]
        buffer.actions = taken.actions[live]
        buffer.observations = windows(episodes)[live]
        buffer.buffer_size, buffer.n_envs = len(buffer.actions), 1
        buffer.full = buffer.generator_ready = True
        return buffer

    def _rewards(self, episodes: Episodes, actor: Actor) -> NDArray[np.float64]:
        """(N, T) rewards, each episode's last one with what comes after it."""
        settings, horizon = self.settings, episodes.horizon
        rewards = -settings.reward_scale * episodes.costs
        later = np.arange(horizon) - (episodes.lengths[:, None] - 1)
        discounts = np.where(later > 0, settings.discount ** np.maximum(later, 0), 0.0)
        rows = np.arange(len(episodes))
        rewards[rows, episodes.lengths - 1] += (discounts * rewards).sum(axis=1)
        cut = np.flatnonzero(episodes.lengths == horizon)
        if len(cut):
            last = window_indices(horizon, episodes.window)[-1]
            final = actor.values(episodes.frames[cut][:, last])
            rewards[cut, -1] += settings.discount * final
        return rewards

    def state_dict(self) -> dict[str, Any]:
        """Network, optimiser, and where it stands within an iteration."""
        return {
            "network": self.network.state_dict(),
            "optimiser": self.network.optimizer.state_dict(),
            "rollouts": self.rollouts,
            "sums": dict(self.sums),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self.network.load_state_dict(state["network"])
        self.network.optimizer.load_state_dict(state["optimiser"])
        self.rollouts, self.sums = state["rollouts"], dict(state["sums"])


def windows(episodes: Episodes) -> NDArray[Any]:
    """(N, T, W C, H, W) or (N, T, W S): what every step was chosen by."""
    if episodes.window == 1:  # a view: no copy of what fills the memory
        return episodes.frames[:, :-1]
    index = window_indices(episodes.horizon, episodes.window)[:-1]
    seen = episodes.frames[:, index]
    return stacked(seen.reshape(-1, *seen.shape[2:])).reshape(*seen.shape[:2], -1, *seen.shape[4:])


def evaluated_after(iteration: int, decade: int) -> int:
    """Rollouts before the evaluation that ends an iteration: 10^(k / decade), to two digits."""
    found, power = 0, 0
    for _ in range(iteration):
        last = found
        while found == last:
            exact = 10 ** (power / decade)
            unit = 10 ** max(0, math.floor(power / decade) - 1)
            found, power = max(last, round(exact / unit) * unit), power + 1
    return found


@contextmanager
def seeded(streams: Streams) -> Iterator[None]:
    """Run foreign code that draws from global streams, on seeds of our own; then restore them."""
    numpys, torchs = np.random.get_state(), torch.get_rng_state()
    try:
        np.random.seed(streams.entropy("numpy") % 2**32)
        torch.manual_seed(streams.seed63("torch"))
        yield
    finally:
        np.random.set_state(numpys)
        torch.set_rng_state(torchs)
