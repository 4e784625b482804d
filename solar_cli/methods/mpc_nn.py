"""MPC-NN (Nagabandi et al. 2018): neural dynamics of states, random shooting, the true cost.

The network predicts changes of the state, both normalised by the first episodes. At every step the
best of random action sequences under it is found, and its first action taken.

Episodes here are shorter than theirs, so a fit is told its gradient steps instead of passes over
the data; held-out episodes choose which parameters are kept.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from solar_cli.control.exploration import Exploration
from solar_cli.control.planning import RolledOut, random_shooting
from solar_cli.control.planning_policy import PlanningPolicy, latents_of
from solar_cli.envs import state_cost
from solar_cli.episodes import Policy
from solar_cli.errors import UsageError
from solar_cli.experience import Experience
from solar_cli.methods import Learner
from solar_cli.methods.reference import Fixed
from solar_cli.models.basis import LatentBasis
from solar_cli.models.neural import NeuralDynamics, Sequences
from solar_cli.models.neural_fit import NeuralModel, NeuralTrainer
from solar_cli.pulse import Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.mpc_nn import MpcNn as MpcNnSettings
from solar_cli.streams import Streams


class MpcNn(Learner):
    """MPC-NN on one cell."""

    def __init__(
        self,
        settings: MpcNnSettings,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.settings, self.task, self.streams, self.device = settings, task, streams, device
        try:
            self.cost = state_cost(task)
        except UsageError as error:
            raise UsageError(
                f"{error}; or choose global-mpc, which learns what states cost"
            ) from error
        if task.observation.window > 1:
            raise UsageError(
                f"task.observation.window = {task.observation.window}: mpc-nn sees one state at a "
                "time; set it to 1, or choose global-mpc"
            )
        self.states = States(task.observation.width, device)
        width, network = task.observation.width, settings.network
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(streams.seed63("weights"))
            dynamics = NeuralDynamics(width, width, task.action.size, network)
        self.model = NeuralModel(dynamics, None).to(device)
        self.trainer = NeuralTrainer(network, streams.under("network"), pulse)

    @property
    def policy(self) -> Policy:
        """The planner, or before anything is known the card's exploration noise."""
        if not self.model.fitted:
            return Exploration(self.task)
        noise = self.settings.shooting.noise * self.task.action.bound
        return PlanningPolicy(latents_of(self.states, 1), self._plan, noise, 0.0, self.task)

    def iterate(self, experience: Experience) -> dict[str, float]:
        """Collect with the planner, and fit the network to all episodes so far."""
        settings, first = self.settings, experience.iteration == 1
        # At first of uniform actions, as those are that it will try.
        policy = Fixed(self.task, self.streams) if first else self.policy
        experience.collect(policy, settings.initial if first else settings.episodes)
        every = [experience.batch(name) for name in experience.batches()]
        seen = [
            Sequences.of(self.states.of(episodes.frames), episodes, self.task.action_cost)
            for episodes in every
        ]
        name = f"iteration {experience.iteration}"
        return self.trainer.fit(name, self.model, seen, 1, settings.shooting.horizon)

    def _plan(self, states: Float[Tensor, "N z"], t: int, before: Tensor | None) -> Tensor:
        """As `Planner`: the best of uniformly drawn sequences."""
        shooting, action = self.settings.shooting, self.task.action
        shape = (shooting.samples, shooting.horizon, action.size)
        draws = self.streams.generator("planning", t).random(shape, dtype=np.float32)
        actions = action.bound * (2.0 * torch.from_numpy(draws).to(states) - 1.0)
        forecast = RolledOut(self.model.dynamics, self.cost, states)
        return random_shooting(forecast, len(states), actions)

    def state_dict(self) -> dict[str, Any]:
        """The network, and a fit that is under way."""
        return {"model": self.model.state_dict(), "trainer": self.trainer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self.model.load_state_dict(state["model"])
        self.trainer.load_state_dict(state["trainer"])


class States:
    """States as they are seen: an `Embedding` with nothing to learn."""

    trained = True

    def __init__(self, size: int, device: str) -> None:
        self.basis = LatentBasis(torch.eye(size, device=device), torch.zeros(size, device=device))
        self._device = device

    def follow(
        self, frames: NDArray[Any], t: int, belief: Any, actions: Float[Tensor, "N a"] | None
    ) -> tuple[Float[Tensor, "N d"], Any]:
        """The states; nothing is carried."""
        return self.of(frames), None

    def of(self, frames: NDArray[Any]) -> Float[Tensor, "*n d"]:
        """The states."""
        return torch.from_numpy(np.ascontiguousarray(frames, np.float32)).to(self._device)
