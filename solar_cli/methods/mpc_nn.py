"""MPC-NN (Nagabandi et al. 2018): neural dynamics of states, random shooting, the true cost.

The network predicts changes of the state, both normalised by the first episodes. At every step the
best of random action sequences under it is found, and its first action taken.

Axes: N episodes, S samples, H steps ahead, d entries of a state, a of an action, n transitions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn

from solar_cli.control.exploration import Exploration
from solar_cli.control.planning import Search, random_shooting
from solar_cli.envs import state_cost
from solar_cli.envs.task import StateCost
from solar_cli.episodes import Episodes, Evaluation, Experience, Policy
from solar_cli.methods import Learner
from solar_cli.pulse import Diverged, Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.mpc_nn import MpcNn as MpcNnSettings
from solar_cli.settings.mpc_nn import NetworkFit
from solar_cli.streams import Streams

Floats = NDArray[np.float64]


class Dynamics(nn.Module):
    """s_{t+1} = s_t + std_y f((s - mean_s) / std_s, (a - mean_a) / std_a) + mean_y."""

    x_mean: Tensor
    x_std: Tensor
    y_mean: Tensor
    y_std: Tensor

    def __init__(self, states: int, actions: int, width: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Linear(states + actions, width), nn.ReLU(), nn.Linear(width, states)
        )
        size = states + actions
        for name, count in (
            ("x_mean", size),
            ("x_std", size),
            ("y_mean", states),
            ("y_std", states),
        ):
            self.register_buffer(name, torch.ones(count))

    def normalise_by(self, x: Float[Tensor, "n p"], y: Float[Tensor, "n d"]) -> None:
        """Take means and deviations from transitions; what is constant keeps its scale."""
        for name, data in (("x", x), ("y", y)):
            std = data.std(dim=0)
            getattr(self, f"{name}_mean").copy_(data.mean(dim=0))
            getattr(self, f"{name}_std").copy_(torch.where(std > 1e-6, std, 1.0))

    def forward(self, states: Float[Tensor, "*n d"], actions: Float[Tensor, "*n a"]) -> Tensor:
        """The next states."""
        x = torch.cat([states, actions], dim=-1)
        change: Tensor = self.body((x - self.x_mean) / self.x_std)
        return states + change * self.y_std + self.y_mean


class Planner:
    """A `Policy` that plans anew at every step."""

    def __init__(
        self, settings: MpcNnSettings, task: TaskSettings, dynamics: Dynamics, streams: Streams
    ) -> None:
        self.task, self.dynamics, self.streams = task, dynamics, streams
        self.noise = settings.shooting.noise * task.action.bound
        self.search = Search(
            settings.shooting.horizon, settings.shooting.samples, 1, 1, task.action.bound
        )
        self.cost: StateCost = state_cost(task)

    def start(self, episodes: int, stream: np.random.Generator | None) -> Floats:
        """(N, T, a) noise of whole episodes."""
        shape = (episodes, self.task.horizon, self.task.action.size)
        return np.zeros(shape) if stream is None else self.noise * stream.standard_normal(shape)

    @torch.no_grad()
    def act(self, observations: NDArray[Any], t: int, state: Floats) -> tuple[Floats, Floats, Any]:
        """The first action of the best sequence, and noise."""
        start = torch.from_numpy(observations[:, -1].astype(np.float32))
        start = start.to(self.dynamics.x_mean.device)
        draws = self.streams.generator("shooting", t)

        def uniform(*shape: int) -> Tensor:
            drawn = draws.random(shape, dtype=np.float32)
            return torch.from_numpy(2 * drawn - 1).to(start.device)

        def forecast(actions: Float[Tensor, "N S H a"]) -> Float[Tensor, "N S"]:
            states = start[:, None].expand(-1, actions.shape[1], -1)
            total = torch.zeros(actions.shape[:2], device=start.device)
            for h in range(actions.shape[2]):
                total = total + self.cost(states, actions[:, :, h])
                states = self.dynamics(states, actions[:, :, h])
            total = total + self.cost(states, 0 * actions[:, :, 0])
            return total.nan_to_num(torch.inf)

        size = self.task.action.size
        best = random_shooting(forecast, len(start), size, self.search, uniform)
        mean = best[:, 0].double().cpu().numpy()
        return mean + state[:, t], mean, state


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
        self.settings, self.task, self.streams = settings, task, streams
        self.device, self.pulse = device, pulse
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(streams.seed63("weights"))
            dynamics = Dynamics(task.observation.width, task.action.size, settings.network.width)
        self.dynamics = dynamics.to(device)
        self.trained = False

    @property
    def policy(self) -> Policy:
        """The planner, or before anything is known the card's exploration noise."""
        if not self.trained:
            return Exploration(self.task)
        return Planner(self.settings, self.task, self.dynamics, self.streams.under("planning"))

    def iterate(self, experience: Experience) -> dict[str, float]:
        """Collect with the planner, and fit the network to all episodes so far."""
        settings, first = self.settings, experience.iteration == 1
        experience.collect(self.policy, settings.initial if first else settings.episodes)
        every = [transitions(experience.batch(name)) for name in experience.batches()]
        x, y = (torch.cat(part).to(self.device) for part in zip(*every, strict=True))
        old = len(every[0][0])
        if not bool(torch.isfinite(y).all()):
            raise Diverged(f"a state of iteration {experience.iteration} is not finite")
        if first:
            self.dynamics.normalise_by(x, y)
        streams = self.streams.under("network", experience.iteration)
        loss = fit(self.dynamics, x, y, old, settings.network, streams, self.pulse)
        self.trained = True
        return {"dynamics_loss": loss}

    def state_dict(self) -> dict[str, Any]:
        """The network."""
        return {"dynamics": self.dynamics.state_dict(), "trained": self.trained}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self.dynamics.load_state_dict(state["dynamics"])
        self.trained = state["trained"]

    def diagnose(self, evaluation: Evaluation) -> dict[str, float]:
        """How much of the changes of state one step ahead is predicted."""
        if not self.trained:
            return {}
        x, y = (part.to(self.device) for part in transitions(evaluation.episodes))
        size = y.shape[-1]
        with torch.no_grad():
            found = self.dynamics(x[:, :size], x[:, size:]) - x[:, :size]
        spread = (y - y.mean(dim=0)).square().sum()
        return {"one_step_r2": 1 - float((found - y).square().sum() / spread.clamp_min(1e-12))}


def transitions(episodes: Episodes) -> tuple[Float[Tensor, "n p"], Float[Tensor, "n d"]]:
    """[s_t; a_t] and s_{t+1} - s_t of live steps."""
    states, live = torch.from_numpy(episodes.frames), torch.from_numpy(episodes.live_steps)
    actions = torch.from_numpy(episodes.actions).to(states)
    x = torch.cat([states[:, :-1], actions], dim=-1)
    return x[live], states.diff(dim=1)[live]


def fit(
    dynamics: Dynamics,
    x: Float[Tensor, "n p"],
    y: Float[Tensor, "n d"],
    old: int,
    settings: NetworkFit,
    streams: Streams,
    pulse: Pulse,
) -> float:
    """Adam on the squared error of normalised changes; the mean loss of the last epoch.

    The first ``old`` transitions are of exploration noise; the planner's make up the share ``new``
    of a batch.
    """
    optimiser = torch.optim.Adam(dynamics.body.parameters(), lr=settings.learning_rate)
    inputs = (x - dynamics.x_mean) / dynamics.x_std
    targets = (y - dynamics.y_mean) / dynamics.y_std
    count, steps = len(x), -(-len(x) // settings.batch)
    fresh = round(settings.new * settings.batch) if count > old else 0
    loss = 0.0
    for epoch in range(settings.epochs):
        draws, total = streams.generator("epoch", epoch), 0.0
        for _ in range(steps):
            rows = draws.integers(old, size=settings.batch - fresh)
            if fresh:
                rows = np.concatenate([rows, draws.integers(old, count, size=fresh)])
            chosen = torch.from_numpy(rows).to(x.device)
            noise = draws.standard_normal((len(rows), x.shape[1] + y.shape[1]), dtype=np.float32)
            spread = settings.noise * torch.from_numpy(noise).to(x.device)
            found = dynamics.body(inputs[chosen] + spread[:, : x.shape[1]])
            error = found - targets[chosen] - spread[:, x.shape[1] :]
            squared = error.square().mean()
            optimiser.zero_grad()
            squared.backward()
            optimiser.step()
            total += float(squared.detach())
        loss = total / steps
        pulse("training the dynamics", (epoch + 1) / settings.epochs)
    return loss
