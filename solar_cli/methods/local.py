"""What local methods share around Algorithm 1: the policy, the trust region, the metrics.

A local method gives `make_prior` and `iterate`.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from itertools import chain, groupby
from typing import Any, NamedTuple

import numpy as np
import torch

from solar_cli.control.latent_policy import LatentPolicy
from solar_cli.control.linear_gaussian import (
    LinearDynamics,
    LinearGaussianPolicy,
    QuadraticCost,
    initial_policy,
)
from solar_cli.control.linearise import Linearisation, linearise_policy
from solar_cli.control.local_dynamics import LocalDynamics, infer_dynamics
from solar_cli.control.lqr import Outcome, PolicyUpdate
from solar_cli.control.step_size import StepSize
from solar_cli.control.task_checks import task_metrics
from solar_cli.control.trajectories import Trajectories
from solar_cli.control.trust_region import Anchor, TrustRegion, promised_fall
from solar_cli.episodes import Episodes
from solar_cli.experience import Experience
from solar_cli.methods.latent import LatentLearner
from solar_cli.models.priors import LatentPrior
from solar_cli.models.state_representation import StateRepresentation
from solar_cli.pulse import Diverged, Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import CostFit, LocalControl
from solar_cli.streams import Streams

MOST_BATCHES = 4
"""of the policy that is built upon, the last ones: bounds memory and time"""


class Lesson(NamedTuple):
    """Episodes that an update is made from."""

    own: list[Episodes]
    """of the policy that is built upon"""
    rejected: list[Episodes]
    """of the last policies that were taken back, which are near"""
    older: list[list[Episodes]]
    """of other iterations, the newest one first"""


class Embedded(NamedTuple):
    """Latent states of a lesson, on the CPU: control runs there."""

    own: Trajectories
    newest: Trajectories
    """own ones, then those of policies that were taken back"""
    older: list[Trajectories]


class LocalLearner(LatentLearner):
    """A representation, a linear-Gaussian policy on its states, and the rules around an update."""

    settings: LocalControl

    def __init__(
        self,
        settings: LocalControl,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        super().__init__(settings, task, streams, device, pulse)
        self.gains = initial_policy(
            task.horizon, self.representation.state_size, task.action.size, task.exploration.std
        )
        self.handed = self.gains
        low, high = settings.update.multiplier
        self.trust_region = TrustRegion(StepSize(low=low, high=high))
        self.updates = 0

    @abstractmethod
    def iterate(self, experience: Experience) -> dict[str, float]:
        """As `Learner.iterate`: one turn of Algorithm 1."""

    @property
    def cost_fit(self) -> CostFit:
        """As the settings say."""
        return self.settings.cost_fit

    @property
    def policy(self) -> LatentPolicy:
        """The newest policy, or the best that was tried where it promises little."""
        return self._acting(self.handed)

    def _acting(self, gains: LinearGaussianPolicy) -> LatentPolicy:
        return LatentPolicy(
            gains,
            self.representation,
            self.task.observation.window,
            self.task.exploration.smoothing,
        )

    def std_bounds(self) -> tuple[float, float]:
        """Least and largest std of the next policy's noise."""
        update, std = self.settings.update, self.task.exploration.std
        early, later = update.std_floor
        floor = early if self.updates < update.early_updates else later
        return floor * std, update.std_ceiling * std

    def max_kl(self, region: TrustRegion, steps: int) -> float | None:
        """Nats that the distribution over ``steps`` time steps may move; None without a bound."""
        step = self.settings.update.kl_step
        if isinstance(step, str):
            return None
        return step * steps * region.step.multiplier

    def collect_and_judge(self, experience: Experience) -> TrustRegion:
        """Line 4: what to build upon, and episodes of it.

        Where the card has episodes without noise, they come first and judge the newest policy. If
        it is worse than the best, the noisy ones are further episodes of the best.
        """
        batches = self.settings.batches
        noisy = batches.initial if experience.iteration == 1 else batches.noisy
        newest = self._acting(self.gains)
        if not batches.noise_free:
            return self._judged(self._collected(experience, newest, noisy))
        judges = self._collected(experience, newest, batches.noise_free, noisy=False)
        region = self._judged(judges)
        again = self._acting(self._best_of_now(experience, region)) if region.rejections else newest
        return region.gathered(self._collected(experience, again, noisy))

    @staticmethod
    def _collected(
        experience: Experience, policy: LatentPolicy, count: int, *, noisy: bool = True
    ) -> Episodes:
        episodes = experience.collect(policy, count, noisy=noisy)
        if not np.isfinite(episodes.costs).all():
            raise Diverged(f"a cost of iteration {experience.iteration} is not finite")
        return episodes

    def _judged(self, episodes: Episodes) -> TrustRegion:
        """What to build upon, after the first episodes of an iteration."""
        tried = Anchor.of(self.gains, episodes)
        return self.trust_region.judged(tried, self.settings.update.reject)

    def _best_of_now(self, experience: Experience, region: TrustRegion) -> LinearGaussianPolicy:
        """The policy that is built upon, on the latents of now."""
        if not self._needs_line_six(region.built_upon):
            return region.built_upon.gains
        own = self.embedded(self.to_learn_from(experience, region)).own
        gains = LocalLearner.linearised(self, region, own).policy
        return gains.held(own.reached, self.task.horizon)

    def to_learn_from(self, experience: Experience, region: TrustRegion) -> Lesson:
        """What an update is made from.

        Episodes of policies that were taken back are part of it: the model that promised much of
        them sees where it was wrong. Without them it may promise the same again: the car of seed 6
        is 3.3 from its target at 320 episodes with `update.rejected_batches` = 0, and .16 with 2.

        An iteration of which only episodes without noise are left, a rejected one, says nothing of
        what actions do.
        """
        own = region.built_upon.batches[-MOST_BATCHES:]
        count = self.settings.update.rejected_batches
        rejected = region.rejected[-count:] if count else ()
        others = [batch for batch in experience.batches() if batch not in (*own, *rejected)]
        groups = [list(group) for _, group in groupby(others, lambda batch: batch.iteration)]
        varied = [group for group in groups if any(batch.noisy for batch in group)]
        recent = varied[::-1][: self.settings.local_fit.older_batches]
        return Lesson(
            [experience.batch(name) for name in own],
            [experience.batch(name) for name in rejected],
            [[experience.batch(name) for name in group] for group in recent],
        )

    def embedded(self, lesson: Lesson) -> Embedded:
        """Latent states of episodes.

        Where episodes ended early, only of the time steps that there is something to plan by.
        """
        newest, *older = (
            Trajectories.joined([self._embedded(self.representation, one) for one in group])
            for group in (lesson.own + lesson.rejected, *lesson.older)
        )
        own = newest.only(slice(sum(map(len, lesson.own))))
        steps = own.planned
        others = [batch.until(steps) for batch in older]
        return Embedded(own.until(steps), newest.until(steps), others)

    @staticmethod
    def _embedded(representation: StateRepresentation, episodes: Episodes) -> Trajectories:
        return Trajectories.of(representation.embed(episodes).cpu(), episodes)

    def latent_prior(self, lesson: Lesson) -> LatentPrior:
        """What the model knows of its dynamics: a source of the prior of line 7."""
        own = self.settings.local_fit.prior_counts == "own"
        others = [*lesson.rejected, *chain.from_iterable(lesson.older)]
        return self.representation.dynamics_prior(others, as_it_stands=own)

    def linearised(self, region: TrustRegion, states: Trajectories) -> Linearisation:
        """Line 6: the policy to improve, in the latents of now.

        It acted on the latents from before its iteration's update: that one or a later one may have
        changed them.
        """
        gains = region.built_upon.gains.until(states.live.shape[1])
        if self._needs_line_six(region.built_upon):
            return linearise_policy(states.z[:, :-1], states.action_means, states.live, gains)
        return Linearisation(gains, residual=0.0, ridge=0.0)

    def _needs_line_six(self, anchor: Anchor) -> bool:
        """Whether latents have changed since this policy first acted."""
        moved = self.representation.moved_in >= anchor.iteration
        return moved and self.settings.update.linearise

    def infer_dynamics(
        self,
        states: Trajectories,
        older: list[Trajectories],
        prior: LatentPrior,
        streams: Streams,
    ) -> LocalDynamics:
        """Line 7: local dynamics around the newest latents."""
        return infer_dynamics(states, older, prior, self.settings.local_fit, streams)

    def checked(self, states: Trajectories, older: list[Trajectories]) -> dict[str, float]:
        """Whether the task shows the last action, and whether episodes are held somewhere."""
        task = self.task
        return task_metrics(states, older, self.latent, task.action_cost, task.action.bound)

    def adopt(
        self,
        region: TrustRegion,
        previous: LinearGaussianPolicy,
        update: PolicyUpdate,
        model: tuple[LinearDynamics, QuadraticCost],
        reached: int,
    ) -> dict[str, float]:
        """Make the update the policy to try next; metrics of the step.

        What it promises is of episodes as they will judge it; what is handed over has no noise.

        What few episodes ``reached`` is planned for, so that there is a future to act for; the
        gains that act for it are those before, which go on.
        """
        if not all(bool(torch.isfinite(part).all()) for part in update.policy):
            raise Diverged("the updated policy is not finite")
        self.gains = update.policy.held(reached, self.task.horizon)
        promised, without_noise = (
            promised_fall(previous, update.policy, *model, noisy=noisy)
            for noisy in (not self.settings.batches.noise_free, False)
        )
        trusted = self.settings.update.reject == "never" or region.trusts(without_noise)
        self.handed = self.gains if trusted else self._best(region, previous, reached)
        self.trust_region = replace(region, promised=promised)
        self.updates += 1
        stuck = update.outcome in (Outcome.NOT_POSITIVE_DEFINITE, Outcome.BRACKET_EXHAUSTED)
        return {
            **region.metrics(),
            "policy_kl": update.kl,
            "policy_std": float(torch.linalg.eigvalsh(update.policy.S).clamp_min(0).sqrt().mean()),
            "dual": update.eta,
            "update_failed": float(stuck),
            "handed_over_untried": float(trusted),
        }

    def _best(
        self, region: TrustRegion, previous: LinearGaussianPolicy, reached: int
    ) -> LinearGaussianPolicy:
        """The best policy that was tried, or where latents have changed the one built upon."""
        assert region.best is not None
        if self._needs_line_six(region.best):
            return previous.held(reached, self.task.horizon)
        return region.best.gains

    def state_dict(self) -> dict[str, Any]:
        """Representation, gains, trust region."""
        return {
            "representation": self.representation.state_dict(),
            "gains": [gain.clone() for gain in self.gains],
            "handed": [gain.clone() for gain in self.handed],
            "trust_region": self.trust_region.state_dict(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self.representation.load_state_dict(state["representation"])
        self.gains = LinearGaussianPolicy(*state["gains"])
        self.handed = LinearGaussianPolicy(*state["handed"])
        self.trust_region = self.trust_region.restored(state["trust_region"])
        self.updates = state["updates"]
