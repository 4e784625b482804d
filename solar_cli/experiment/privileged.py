"""A local method some parts of which are answered by an observer that knows the simulator.

For a diagnosis only: nothing that is computed here may be stored as a method's result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, cast

import numpy as np
import torch

from solar_cli.control.latent_policy import LatentPolicy
from solar_cli.control.linearise import Linearisation
from solar_cli.control.local_dynamics import LocalDynamics, infer_dynamics
from solar_cli.control.quadratic_cost import FittedCost, fit_quadratic_cost
from solar_cli.control.trajectories import Trajectories
from solar_cli.control.trust_region import TrustRegion
from solar_cli.envs import Task
from solar_cli.envs.task import Floats, Frames
from solar_cli.episodes import Episodes, Policy, roll_out
from solar_cli.experience import Experience
from solar_cli.methods.local import LocalLearner
from solar_cli.models.priors import LatentPrior
from solar_cli.models.representation import Representation
from solar_cli.models.state_representation import StateRepresentation
from solar_cli.settings import Observation, TaskSettings
from solar_cli.settings.local import CostFit, LocalControl, LocalMethod
from solar_cli.streams import Streams

ROLLOUTS = 20
"""batches of a policy that are rolled out: a time step's fits have so many times the samples of an
iteration's episodes with noise"""
OWN_STEP = 1e-3  # reach of a cost's fit in time steps: neighbours weigh nothing
VARIANCE = 1e-8  # of q(z | s) around a position, in units of its variance


class Part(StrEnum):
    """What an observer can put in the place of what a method has learned."""

    STATE = "true state"
    DYNAMICS = "simulator's dynamics"
    COST = "true cost"


@dataclass(frozen=True)
class World:
    """What the observer rolls out in; no episode of it counts."""

    task: Task
    settings: TaskSettings
    streams: Streams

    def roll_out(self, policy: Policy, episodes: int, *key: int) -> Episodes:
        """Episodes of the policy with its noise; the same ``key``, the same draws."""
        streams = self.streams.under(*key)
        resets = [streams.generator("reset", i) for i in range(episodes)]
        noise = streams.generator("noise")
        return roll_out(self.task, self.settings, policy, resets, noise).episodes


class SeenWhole:
    """A task whose frames (N, k) are its true positions; all else is as it was."""

    def __init__(self, task: Task) -> None:
        self._task = task

    def __getattr__(self, name: str) -> Any:
        return getattr(self._task, name)

    def reset(self, streams: Sequence[np.random.Generator]) -> Frames:
        """As `Task.reset`."""
        self._task.reset(streams)
        return self._positions()

    def step(self, actions: Floats) -> tuple[Frames, Floats]:
        """As `Task.step`."""
        _, costs = self._task.step(actions)
        return self._positions(), costs

    def _positions(self) -> Frames:
        return self._task.truth().astype(np.float32)


def seen_whole(task: Task) -> Task:
    """The task with true positions for frames."""
    return cast(Task, SeenWhole(task))


def of_positions(
    task: TaskSettings, method: LocalControl, size: int
) -> tuple[TaskSettings, LocalControl]:
    """Settings for frames of ``size`` positions, in the card's window: the network is no layer."""
    observation = Observation(kind="state", width=size, window=task.observation.window)
    identity = {
        "latent": size,
        "encoder": (),
        "head": "none",
        "variance": VARIANCE,
        "decoder": (),
        "likelihood": "gaussian",
        "input": "standardised",
    }
    if isinstance(method, LocalMethod):
        representation = method.representation.model_copy(update=identity)
        method = method.model_copy(update={"representation": representation})
    return task.model_copy(update={"observation": observation}), method


class TrueState(Representation):
    """Positions as they are, in the basis that latents would be given; nothing is trained."""

    def update(self, experience: Experience) -> dict[str, float]:
        """The basis from the first batch, and the prior's factors from the last ones."""
        recent = experience.recent(self.settings.training.buffer)
        if not self._trained:
            first = np.concatenate([episodes.frames for episodes in recent])
            self._model.networks.standardise_by(
                torch.from_numpy(first).flatten(0, 1).to(self.device)
            )
        self._conclude(recent)
        if not self._trained:
            self._model.prior.settle()
            self._basis = self._whitening(self._encoded(recent))
            self._trained, self.moved_in = True, experience.iteration
        return self._model.prior.metrics()


class Privileged(LocalLearner):
    """The hooks of a local method, those of the parts that are ``given`` answered by an observer.

    Dynamics and cost are least squares at each time step, without a prior and without neighbours,
    from rollouts of the very policy that collected the batch built upon, in the latents of now:
    what finite differences through a simulator would give around that policy, and it takes no more
    of a simulator than that it runs.
    """

    given: frozenset[Part]
    world: World

    def __init__(self, *arguments: Any) -> None:
        self._tried: dict[int, LatentPolicy] = {}
        self._rollouts: Trajectories | None = None
        super().__init__(*arguments)

    def make_representation(self) -> StateRepresentation:
        """True positions, or the method's own; one that learns none takes positions as they are."""
        if Part.STATE not in self.given or not isinstance(self.settings, LocalMethod):
            return super().make_representation()
        return self.untrained(TrueState)

    def collect_and_judge(self, experience: Experience) -> TrustRegion:
        """As the method; the policy is kept, with the representation that it acts on."""
        frozen = self.make_representation()
        frozen.load_state_dict(self.representation.state_dict())
        self._tried[experience.iteration] = LatentPolicy(
            self.gains, frozen, self.task.observation.window, self.task.exploration.smoothing
        )
        self._rollouts = None
        return super().collect_and_judge(experience)

    def linearised(self, region: TrustRegion, states: Trajectories) -> Linearisation:
        """As the method; line 6 is where the latents of now and the batch built upon are known.

        Rollouts are of the time steps that it is planned for, where episodes end early.
        """
        if self.given & {Part.DYNAMICS, Part.COST}:
            steps = states.live.shape[1]
            self._rollouts = self._rolled_out(region.built_upon.iteration).until(steps)
        return super().linearised(region, states)

    def infer_dynamics(
        self,
        states: Trajectories,
        older: list[Trajectories],
        prior: LatentPrior,
        streams: Streams,
    ) -> LocalDynamics:
        """Of the rollouts, or as the method."""
        if Part.DYNAMICS not in self.given or self._rollouts is None:
            return super().infer_dynamics(states, older, prior, streams)
        plain = self.settings.local_fit.model_copy(update={"method": "regression"})
        return infer_dynamics(self._rollouts, [], prior, plain, streams)

    def fitted_cost(self, states: Trajectories, older: list[Trajectories]) -> FittedCost:
        """Of the rollouts, or as the method, which judges representations by it before there are
        any."""
        if Part.COST not in self.given or self._rollouts is None:
            return super().fitted_cost(states, older)
        settings = CostFit(width=OWN_STEP, terminal=self.settings.cost_fit.terminal)
        return fit_quadratic_cost(self._rollouts, [], self.task.action_cost, settings, self.latent)

    def _rolled_out(self, iteration: int) -> Trajectories:
        """The policy that collected that iteration, batch by batch: frames fill the memory."""
        policy, size = self._tried[iteration], self.settings.batches.noisy
        rollouts = (self.world.roll_out(policy, size, iteration, k) for k in range(ROLLOUTS))
        batches = [Trajectories.of(self.representation.embed(one).cpu(), one) for one in rollouts]
        return Trajectories.joined(batches)


def privileged(
    kind: type[LocalLearner], given: frozenset[Part], world: World
) -> type[LocalLearner]:
    """The method ``kind`` with the parts that are ``given``."""
    return type(kind.__name__, (Privileged, kind), {"given": given, "world": world})
