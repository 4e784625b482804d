"""The policy of an actor-critic, as episodes meet it: it notes what a learner on policy needs."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

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
        self._steps: list[list[tuple[NDArray[Any], ...]]] = []  # of each group of episodes

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
        network.action_dist.noise = torch.from_numpy(state[:, t]).to(network.device)
        drawn, values, log_probs = (part.cpu() for part in network(seen))
        means = network.action_dist.mode().double().cpu().numpy() * bound
        self._steps[-1].append((drawn.numpy(), values[:, 0].numpy(), log_probs.numpy()))
        return drawn.double().numpy() * bound, means, state

    def taken(self) -> Taken:
        """What was noted, of all episodes in their order."""
        return Taken(
            *(
                np.concatenate(
                    [np.stack([step[part] for step in group], axis=1) for group in self._steps]
                )
                for part in range(len(Taken._fields))
            )
        )

    @torch.no_grad()
    def values(self, observations: NDArray[Any]) -> Floats32:
        """(N,) what is expected from windows (N, W, *frame)."""
        seen = torch.from_numpy(stacked(observations)).to(self.network.device)
        found: Floats32 = self.network.predict_values(seen)[:, 0].cpu().numpy()
        return found


def stacked(windows: NDArray[Any]) -> NDArray[Any]:
    """Windows (n, W, C, H, W) as one image of W C channels; of states, (n, W, S), end to end."""
    return windows.reshape(len(windows), -1, *windows.shape[3:])
