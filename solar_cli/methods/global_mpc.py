"""The global-model ablation (section 6): neural dynamics and cost in SOLAR's latent space, and MPC.

The representation is SOLAR's own, trained as SOLAR trains it. Then one network for the whole space
and all time steps says what an action changes, another one what a state costs, and the
cross-entropy method plans with both at every step.

What the dynamics predict, the change of the newest latents, is what they are rolled out with, and
they are trained over several steps of that; the authors' release trained another thing than it
used. A plan goes on from that of the step before, so that fewer samples and iterations than the
release's do. Nothing but a card's variant tells it that a car should drive forward (section 6.2).
The first evaluation with a model is the one after the initial episodes.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from solar_cli.control.exploration import Exploration, smooth_noise
from solar_cli.control.planning import RolledOut, Search, cross_entropy, shifted
from solar_cli.control.planning_policy import PlanningPolicy, latents_of
from solar_cli.episodes import Batch, Policy
from solar_cli.errors import UsageError
from solar_cli.experience import Experience
from solar_cli.methods.latent import LatentLearner
from solar_cli.models.neural import NeuralCost, NeuralDynamics, Sequences
from solar_cli.models.neural_fit import NeuralModel, NeuralTrainer
from solar_cli.models.priors import Prior
from solar_cli.models.smoothing import linear_dynamics
from solar_cli.pulse import Diverged, Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.global_mpc import GlobalMpc as GlobalMpcSettings
from solar_cli.streams import Streams


class GlobalMpc(LatentLearner):
    """The global-model ablation on one cell."""

    settings: GlobalMpcSettings

    def __init__(
        self,
        settings: GlobalMpcSettings,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        super().__init__(settings, task, streams, device, pulse)
        if len(settings.planner.mean) not in (0, task.action.size):
            raise UsageError(
                f"planner.mean = {list(settings.planner.mean)}: give one number for each of the "
                f"{task.action.size} entries of an action, or none"
            )
        size, network = self.representation.state_size, settings.network
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(streams.seed63("network weights"))
            newest = self.representation.latent  # hidden ones too
            dynamics = NeuralDynamics(size, newest, task.action.size, network)
            cost = NeuralCost(self.latent, network)
        self.model = NeuralModel(dynamics, cost).to(device)
        self.trainer = NeuralTrainer(network, streams.under("network"), pulse)
        self._represented: dict[str, float] | None = None  # in an iteration under way
        self._seen: dict[Batch, Sequences] = {}  # by the representation as it is

    def make_prior(self) -> Prior:
        """SOLAR's (Eq. 2 and 3)."""
        return linear_dynamics(self.settings.dynamics, self.latent, self.task, self.device)

    @property
    def policy(self) -> Policy:
        """The planner, or before anything is known the card's exploration noise."""
        if not self.model.fitted:
            return Exploration(self.task)
        exploration = self.task.exploration
        noise = self.settings.planner.noise * exploration.std
        see = latents_of(self.representation, self.task.observation.window)
        return PlanningPolicy(see, self._plan, noise, exploration.smoothing, self.task)

    def iterate(self, experience: Experience) -> dict[str, float]:
        """Collect with the planner; fit the representation, then both networks to all episodes."""
        self._collect(experience)
        if self._represented is None:  # else it goes on in an iteration that was interrupted
            self._represented = self.representation.update(experience)
            self.model.dynamics.shift_by(self.representation.basis)
        batches = experience.batches()
        explored = sum(batch.iteration == 1 for batch in batches)
        fitted = self.trainer.fit(
            f"iteration {experience.iteration}",
            self.model,
            self._embedded(experience),
            explored,
            self.settings.planner.horizon,
        )
        represented, self._represented = self._represented, None
        seconds = represented.get("seconds_training", 0.0) + fitted["seconds_training"]
        return {**represented, **fitted, "seconds_training": seconds}

    def _collect(self, experience: Experience) -> None:
        """Line 4 of Algorithm 1; where a card has episodes that judge, they explore here too."""
        batches = self.settings.batches
        noisy = batches.initial if experience.iteration == 1 else batches.noisy
        episodes = experience.collect(self.policy, noisy + batches.noise_free)
        if not bool(torch.isfinite(torch.from_numpy(episodes.costs)).all()):
            raise Diverged(f"a cost of iteration {experience.iteration} is not finite")

    def _embedded(self, experience: Experience) -> list[Sequences]:
        """All batches, each embedded once by the same representation."""
        if self.representation.moved_in == experience.iteration:
            self._seen.clear()
        for batch in experience.batches():
            if batch not in self._seen:
                episodes = experience.batch(batch)
                states = self.representation.embed(episodes).float()
                self._seen[batch] = Sequences.of(states, episodes, self.task.action_cost)
        return [self._seen[batch] for batch in experience.batches()]

    def _plan(
        self, states: Float[Tensor, "N z"], t: int, before: Float[Tensor, "N H a"] | None
    ) -> Float[Tensor, "N H a"]:
        """As `Planner`: the cross-entropy method, from the plan of the step before."""
        settings, action = self.settings.planner, self.task.action
        shape = (settings.samples, settings.horizon, action.size)
        idle = action.bound * torch.tensor(settings.mean or (0.0,) * action.size).to(states)
        if before is None:
            mean = idle.expand(len(states), settings.horizon, -1)
        else:
            mean = shifted(before, idle)
        smoothing = self.task.exploration.smoothing

        def normal(iteration: int) -> Float[Tensor, "S H a"]:
            draws = self.streams.generator("planning", t, iteration)
            return torch.from_numpy(smooth_noise(shape, smoothing, draws)).to(states)

        search = Search(
            iterations=settings.iterations,
            elites=settings.elites,
            bound=action.bound,
            std=settings.std * action.bound,
            least_std=settings.least_std * action.bound,
        )
        return cross_entropy(
            RolledOut(self.model.dynamics, self._cost, states), mean, search, normal
        )

    def _cost(self, states: Float[Tensor, "n z"], actions: Float[Tensor, "n a"]) -> Tensor:
        """c(z) as learned, and alpha |a|^2, which is known."""
        assert self.model.cost is not None
        return self.model.cost.of(states) + self.task.action_cost * actions.square().sum(dim=-1)

    def state_dict(self) -> dict[str, Any]:
        """Representation, networks, and a fit that is under way."""
        return {
            "representation": self.representation.state_dict(),
            "represented": self._represented,
            "model": self.model.state_dict(),
            "trainer": self.trainer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self.representation.load_state_dict(state["representation"])
        self._represented = state["represented"]
        self.model.load_state_dict(state["model"])
        self.trainer.load_state_dict(state["trainer"])
        self._seen.clear()
