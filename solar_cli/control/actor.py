"""The policy of an actor-critic, as episodes meet it: it notes what a learner on policy needs."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.distributions import Normal

from solar_cli.models.actor_critic import ActorCriticOfLayers
from solar_cli.settings import TaskSettings

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]


class Taken(NamedTuple):
    """What was drawn at each step, N episodes of T steps, and what was thought of it."""

    actions: Floats32
    """(N, T, a) over the bound, before clipping"""
    values: Floats32
    """(N, T) expected return from there"""
    log_probs: Floats32
    """(N, T)"""


class Actor:
    """A `Policy` with white noise; its actions are the network's times the bound."""

    def __init__(self, network: ActorCriticOfLayers, task: TaskSettings) -> None:
        self.network, self.task = network, task
        self._steps: list[list[tuple[Floats32, Floats32, Floats32]]] = []
        # of each group of episodes: what was drawn, its means, values

    def start(self, episodes: int, stream: np.random.Generator | None) -> Floats32 | None:
        """(N, T, a) noise of whole episodes, in units of its std."""
        self.network.set_training_mode(False)
        if stream is None:
            return None
        self._steps.append([])
        shape = (episodes, self.task.horizon, self.task.action.size)
        return stream.standard_normal(shape, dtype=np.float32)

    @torch.no_grad()
    def act(
        self, observations: NDArray[Any], t: int, state: Floats32 | None
    ) -> tuple[Floats, Floats, Floats32 | None]:
        """As `Policy.act`; with noise, every step is noted."""
        network, bound = self.network, self.task.action.bound
        seen = torch.from_numpy(stacked(observations)).to(network.device)
        if state is None:
            means = network.get_distribution(seen).mode().double().cpu().numpy() * bound
            return means, means, state
        mean, value = (part.cpu().numpy() for part in network.mean_and_value(seen))
        drawn = mean + network.log_std.exp().cpu().numpy() * state[:, t]
        self._steps[-1].append((drawn, mean, value[:, 0]))
        return drawn.astype(np.float64) * bound, mean.astype(np.float64) * bound, state

    @torch.no_grad()
    def taken(self) -> Taken:
        """What was noted, of all episodes in their order."""
        drawn, means, values = (
            np.concatenate([np.stack(part, axis=1) for part in parts])
            for parts in zip(*(zip(*group, strict=True) for group in self._steps), strict=True)
        )
        stds = self.network.log_std.exp().cpu()
        known = Normal(torch.from_numpy(means), stds, validate_args=False)
        log_probs: Floats32 = known.log_prob(torch.from_numpy(drawn)).sum(dim=-1).numpy()  # type: ignore[no-untyped-call]
        return Taken(drawn, values, log_probs)

    @torch.no_grad()
    def values(self, observations: NDArray[Any]) -> Floats32:
        """(N,) what is expected from windows (N, W, *frame)."""
        seen = torch.from_numpy(stacked(observations)).to(self.network.device)
        found: Floats32 = self.network.predict_values(seen)[:, 0].cpu().numpy()
        return found


def stacked(windows: NDArray[Any]) -> NDArray[Any]:
    """Windows (n, W, C, H, W) as one image of W C channels; of states, (n, W, S), end to end."""
    return windows.reshape(len(windows), -1, *windows.shape[3:])
