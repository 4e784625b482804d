"""A policy that plans anew at every step, takes the first action of each plan, and adds noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from solar_cli.control.exploration import smooth_noise
from solar_cli.control.latent_policy import Embedding, Followed, latest_state
from solar_cli.settings import TaskSettings

Floats = NDArray[np.float64]


class Planner(Protocol):
    """What chooses actions for the next H steps."""

    def __call__(
        self, seen: Float[Tensor, "N *z"], t: int, before: Float[Tensor, "N H a"] | None, /
    ) -> Float[Tensor, "N H a"]:
        """Plans for step ``t``; ``before`` are those of the step before, None at the start."""


class Acting(NamedTuple):
    """What is carried through an episode."""

    noise: Floats
    """(N, T, a)"""
    followed: Followed = Followed()
    plan: Float[Tensor, "N H a"] | None = None
    actions: Float[Tensor, "N a"] | None = None
    """of the step before"""


See = Callable[[NDArray[Any], int, Acting], tuple[Tensor, Followed]]
"""What to plan from at a step, given windows (N, W, *frame), and what the next step is given."""


def latents_of(embedding: Embedding, window: int) -> See:
    """States of an embedding; only the newest frame is encoded."""

    def see(
        observations: NDArray[Any], t: int, state: Acting
    ) -> tuple[Float[Tensor, "N z"], Followed]:
        z, followed = latest_state(
            embedding, observations, t, state.followed, state.actions, window
        )
        return z.float(), followed

    return see


class PlanningPolicy:
    """a_t: the first action of the plan for what is seen, and noise of deviation ``std``."""

    def __init__(
        self, see: See, planner: Planner, std: float, smoothing: float, task: TaskSettings
    ) -> None:
        self.see, self.planner = see, planner
        self.std, self.smoothing, self.task = std, smoothing, task

    def start(self, episodes: int, stream: np.random.Generator | None) -> Acting:
        """Draw the noise of whole episodes."""
        shape = (episodes, self.task.horizon, self.task.action.size)
        if stream is None:
            return Acting(np.zeros(shape))
        return Acting(self.std * smooth_noise(shape, self.smoothing, stream))

    @torch.no_grad()
    def act(
        self, observations: NDArray[Any], t: int, state: Acting
    ) -> tuple[Floats, Floats, Acting]:
        """As `Policy.act`."""
        seen, followed = self.see(observations, t, state)
        plan = self.planner(seen, t, state.plan)
        mean = plan[:, 0].double().cpu().numpy()
        action = mean + state.noise[:, t]
        acted = Acting(state.noise, followed, plan, torch.from_numpy(action.copy()))
        return action, mean, acted
