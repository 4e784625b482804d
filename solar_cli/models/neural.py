"""Neural models to plan with: what an action changes, what a state costs, how good both are.

Axes: N episodes, T actions an episode, n any rows, K steps of a segment; z entries of a state of
which the first d are its newest block, a entries of an action.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from solar_cli.episodes import Episodes
from solar_cli.models.basis import LatentBasis
from solar_cli.models.networks import perceptron
from solar_cli.settings.neural import NeuralFit

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {
    "relu": partial(nn.ReLU, inplace=True),
    "silu": nn.SiLU,
}
LEAST_STD = 1e-6
"""what varies less is constant, and keeps its scale"""


class Sequences(NamedTuple):
    """Episodes as these models see them, float32."""

    states: Float[Tensor, "N T1 z"]
    actions: Float[Tensor, "N T a"]
    costs: Float[Tensor, "N T"]
    """without the part that is known, of actions"""
    live: Bool[Tensor, "N T"]
    """whether an episode was still running: other steps are not learned from"""

    @staticmethod
    def of(states: Float[Tensor, "N T1 z"], episodes: Episodes, action_cost: float) -> Sequences:
        """States of ``episodes`` with what was done, and what else it cost than alpha |a|^2."""
        actions = torch.from_numpy(episodes.actions).to(states.device)
        costs = torch.from_numpy(episodes.costs).to(states.device)
        return Sequences(
            states,
            actions.to(states),
            (costs - action_cost * actions.square().sum(dim=-1)).to(states),
            torch.from_numpy(episodes.live_steps).to(states.device),
        )

    @staticmethod
    def joined(parts: Sequence[Sequences]) -> Sequences:
        """All episodes of several batches, in order."""
        return Sequences(*(torch.cat(part) for part in zip(*parts, strict=True)))

    def __len__(self) -> int:
        return len(self.states)

    def some(self, rows: slice) -> Sequences:
        """Some of the episodes."""
        return Sequences(*(part[rows] for part in self))

    @property
    def longest(self) -> int:
        """Live steps of the longest episode."""
        return int(self.live.sum(dim=1).max())

    def starts(self, steps: int) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
        """(episode, time step) that each run of ``steps`` live steps begins with, in order."""
        whole = self.live.unfold(1, steps, 1).all(dim=-1)
        episode, step = whole.nonzero(as_tuple=True)
        return episode, step

    def segments(self, episode: Tensor, step: Tensor, steps: int) -> Segment:
        """Those that begin there."""
        at = step[:, None] + torch.arange(steps + 1, device=step.device)
        rows = episode[:, None]
        return Segment(
            self.states[rows, at], self.actions[rows, at[:, :-1]], self.costs[rows, at[:, :-1]]
        )


class Segment(NamedTuple):
    """Consecutive live steps of ``n`` episodes."""

    states: Float[Tensor, "n K1 z"]
    actions: Float[Tensor, "n K a"]
    costs: Float[Tensor, "n K"]


class Standardised(nn.Module):
    """y = mean_y + std_y f((x - mean_x) / std_x): a network on what it was shown first."""

    x_mean: Tensor
    x_std: Tensor
    y_mean: Tensor
    y_std: Tensor

    def __init__(self, inputs: int, outputs: int, settings: NeuralFit) -> None:
        super().__init__()
        activation = ACTIVATIONS[settings.activation]
        self.body = perceptron(inputs, settings.widths, outputs, activation)
        for name, count in (("x", inputs), ("y", outputs)):
            self.register_buffer(f"{name}_mean", torch.zeros(count))
            self.register_buffer(f"{name}_std", torch.ones(count))

    def standardise_by(self, x: Float[Tensor, "n i"], y: Float[Tensor, "n o"]) -> None:
        """Take means and deviations from samples."""
        for name, data in (("x", x), ("y", y)):
            std = data.std(dim=0)
            getattr(self, f"{name}_mean").copy_(data.mean(dim=0))
            getattr(self, f"{name}_std").copy_(torch.where(std > LEAST_STD, std, 1.0))

    def forward(self, x: Float[Tensor, "*n i"]) -> Float[Tensor, "*n o"]:
        """y."""
        y: Tensor = self.body((x - self.x_mean) / self.x_std)
        return torch.addcmul(self.y_mean, y, self.y_std)


class NeuralDynamics(nn.Module):
    """u_{t+1} = u_t + f(z_t, a_t) for the newest block u; what the rest of a state does is known.

    Without a basis a state is its newest block. With one it is a window of latents, which shifts:
    z_{t+1} = P z_t + G u_{t+1} + h (`LatentBasis.successor`).
    """

    P: Tensor
    G: Tensor
    h: Tensor

    def __init__(self, state: int, newest: int, action: int, settings: NeuralFit) -> None:
        super().__init__()
        self.newest = newest
        self.change = Standardised(state + action, newest, settings)
        if state > newest:
            self.register_buffer("P", torch.zeros(state, state))
            self.register_buffer("G", torch.zeros(state, newest))
            self.register_buffer("h", torch.zeros(state))

    def shift_by(self, basis: LatentBasis) -> None:
        """Take up what a window's older blocks do."""
        if len(basis.b) > self.newest:
            for name, part in zip("PGh", basis.successor(self.newest), strict=True):
                getattr(self, name).copy_(part)

    def changes(self, states: Tensor, actions: Tensor) -> Float[Tensor, "*n d"]:
        """u_{t+1} - u_t."""
        found: Tensor = self.change(torch.cat([states, actions], dim=-1))
        return found

    def follow(self, states: Tensor, changes: Tensor) -> Float[Tensor, "*n z"]:
        """z_{t+1}."""
        if states.shape[-1] == self.newest:
            return states + changes
        newest = states[..., : self.newest] + changes
        return torch.addmm(self.h, states, self.P.T).addmm_(newest, self.G.T)

    def forward(self, states: Float[Tensor, "n z"], actions: Float[Tensor, "n a"]) -> Tensor:
        """z_{t+1}."""
        return self.follow(states, self.changes(states, actions))

    def rolled(
        self, start: Float[Tensor, "n z"], actions: Float[Tensor, "n K a"]
    ) -> Float[Tensor, "n K z"]:
        """The states after each of some actions, each made from the one predicted before."""
        states = [start]
        for k in range(actions.shape[1]):
            states.append(self(states[-1], actions[:, k]))
        return torch.stack(states[1:], dim=1)


class NeuralCost(Standardised):
    """c(u): what the newest block of a state costs, the part of actions aside."""

    def __init__(self, newest: int, settings: NeuralFit) -> None:
        super().__init__(newest, 1, settings)
        self.newest = newest

    def of(self, states: Float[Tensor, "*n z"]) -> Float[Tensor, "*n"]:
        """Costs of states."""
        found: Tensor = self(states[..., : self.newest])
        return found.squeeze(-1)


def explained(found: Float[Tensor, "n *k"], true: Float[Tensor, "n *k"]) -> float:
    """R2 over all entries together: 1 for nothing to explain."""
    spread = (true - true.mean(dim=0)).square().sum()
    if float(spread) == 0.0:
        return 1.0
    return 1.0 - float((found - true).square().sum() / spread)


@torch.no_grad()
def prediction_r2(dynamics: NeuralDynamics, seen: Sequences, steps: int) -> float:
    """Share of what the newest block changes in ``steps`` steps that is predicted."""
    steps, d = min(steps, seen.longest), dynamics.newest
    segment = seen.segments(*seen.starts(steps), steps)
    found = dynamics.rolled(segment.states[:, 0], segment.actions)[:, -1, :d]
    start = segment.states[:, 0, :d]
    return explained(found - start, segment.states[:, -1, :d] - start)


@torch.no_grad()
def cost_r2(cost: NeuralCost, seen: Sequences) -> float:
    """Share of the variance of costs that is predicted, of states as they were seen."""
    return explained(cost.of(seen.states[:, :-1])[seen.live], seen.costs[seen.live])
