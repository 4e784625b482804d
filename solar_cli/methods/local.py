"""What local methods share around Algorithm 1: the policy, the trust region, the metrics.

A local method gives `make_prior` (or another representation) and `iterate`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from solar_cli.control.latent_policy import LatentPolicy
from solar_cli.control.linear_gaussian import LinearGaussianPolicy, initial_policy
from solar_cli.control.linearise import Linearisation, linearise_policy
from solar_cli.control.local_dynamics import LocalDynamics
from solar_cli.control.lqr import Outcome, PolicyUpdate
from solar_cli.control.quadratic_cost import FittedCost, fit_quadratic_cost
from solar_cli.control.step_size import StepSize
from solar_cli.control.trajectories import Trajectories
from solar_cli.control.trust_region import Anchor, TrustRegion
from solar_cli.episodes import Environment, Episodes, Evaluation
from solar_cli.models.priors import Prior
from solar_cli.models.representation import Representation
from solar_cli.pulse import Diverged, Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import LocalMethod
from solar_cli.streams import Streams


class LocalLearner:
    """A representation, a linear-Gaussian policy on its states, and the rules around an update."""

    def __init__(
        self,
        settings: LocalMethod,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.settings = settings
        self.task = task
        self.streams = streams
        self.device = device
        self.pulse = pulse
        self.latent = settings.representation.latent
        self.representation = Representation(
            settings, task, self.make_prior, self._cost_score, streams, device, pulse
        )
        self.gains = initial_policy(
            task.horizon, self.representation.state_size, task.action.size, task.exploration.std
        )
        low, high = settings.update.multiplier
        self.trust_region = TrustRegion(StepSize(low=low, high=high))
        self.updates = 0

    def make_prior(self) -> Prior:
        """The prior over latents that the representation is trained with."""
        raise NotImplementedError

    @property
    def policy(self) -> LatentPolicy:
        """The newest policy."""
        return LatentPolicy(
            self.gains,
            self.representation,
            self.task.observation.window,
            self.task.exploration.smoothing,
        )

    @property
    def std_bounds(self) -> tuple[float, float]:
        """Least and largest std of the next policy's noise."""
        update, std = self.settings.update, self.task.exploration.std
        early, later = update.std_floor
        floor = early if self.updates < update.early_updates else later
        return floor * std, update.std_ceiling * std

    def max_kl(self, region: TrustRegion) -> float | None:
        """Nats that the trajectory distribution may move; None without a bound."""
        step = self.settings.update.kl_step
        if isinstance(step, str):
            return None
        return step * self.task.horizon * region.step.multiplier

    def collect(self, environment: Environment) -> Anchor:
        """Line 4: episodes of the current policy, judged without noise where the card says so."""
        batches = self.settings.batches
        count = batches.initial if environment.iteration == 1 else batches.noisy
        judged = environment.collect(self.policy, count)
        if batches.noise_free and environment.iteration > 1:
            judged = environment.collect(self.policy, batches.noise_free, noisy=False)
        if not np.isfinite(judged.costs).all():
            raise Diverged(f"a cost of iteration {environment.iteration} is not finite")
        return Anchor.of(environment.iteration, self.gains, judged)

    def batches(
        self, environment: Environment, region: TrustRegion
    ) -> tuple[Episodes, list[Episodes]]:
        """The episodes to update from, and those of older iterations, newest first."""
        assert region.current is not None
        chosen = region.current.iteration
        first = max(1, environment.iteration - self.settings.local_fit.older_batches)
        others = [i for i in range(environment.iteration, first - 1, -1) if i != chosen]
        older = [Episodes.joined(environment.collected(iteration)) for iteration in others]
        return Episodes.joined(environment.collected(chosen)), older

    def embedded(self, episodes: Episodes) -> Trajectories:
        """Latent states of episodes, on the CPU: control runs there."""
        return Trajectories.of(self.representation.embed(episodes).cpu(), episodes)

    def linearised(self, region: TrustRegion, states: Trajectories) -> Linearisation:
        """Line 6: the policy to improve, in the latents of now."""
        assert region.current is not None
        gains = region.current.gains
        if self.representation.moved and self.settings.update.linearise:
            return linearise_policy(states.z[:, :-1], states.action_means, gains)
        return Linearisation(gains, residual=0.0, ridge=0.0)

    def adopted(
        self,
        region: TrustRegion,
        fit: dict[str, float],
        previous: Linearisation,
        dynamics: LocalDynamics,
        cost: FittedCost,
        update: PolicyUpdate,
    ) -> dict[str, float]:
        """Make the update the policy to try next; the metrics of the iteration."""
        if not all(bool(torch.isfinite(part).all()) for part in update.policy):
            raise Diverged("the updated policy is not finite")
        self.gains = update.policy
        self.trust_region = replace(
            region, promised=update.predicted_before - update.predicted_after
        )
        self.updates += 1
        return {
            **fit,
            **dynamics.metrics,
            **region.metrics(),
            "cost_r2": cost.r2,
            "cost_per_time": float(cost.per_time),
            "linearisation_residual": previous.residual,
            "kl": update.kl,
            "eta": update.eta,
            "update_outcome": float(list(Outcome).index(update.outcome)),
            "policy_std": float(torch.linalg.eigvalsh(update.policy.S).clamp_min(0).sqrt().mean()),
        }

    def diagnose(self, evaluation: Evaluation) -> dict[str, float]:
        """R2 of linear maps between true positions and the newest latents, both ways."""
        if not self.representation.trained or not evaluation.truth.shape[-1]:
            return {}
        states = self.representation.embed(evaluation.episodes)[..., : self.latent]
        latents = states.flatten(0, 1).cpu().numpy()
        truth = evaluation.truth.reshape(len(latents), -1)
        found = _linear_r2(latents, truth)
        shaped = _linear_r2(truth, latents)
        return {
            **{
                f"truth_r2_{name}": float(r2)
                for name, r2 in zip(evaluation.truth_names, found, strict=True)
            },
            **{f"latent_r2_{i}": float(r2) for i, r2 in enumerate(shaped)},
        }

    def reconstruct(self, episodes: Episodes) -> NDArray[Any] | None:
        """Frames as the observation model expects them from the encoder's mean."""
        return self.representation.reconstruct(episodes) if self.representation.trained else None

    def state_dict(self) -> dict[str, Any]:
        """Representation, gains, trust region."""
        return {
            "representation": self.representation.state_dict(),
            "gains": [gain.clone() for gain in self.gains],
            "trust_region": self.trust_region.state_dict(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self.representation.load_state_dict(state["representation"])
        self.gains = LinearGaussianPolicy(*state["gains"])
        self.trust_region = self.trust_region.restored(state["trust_region"])
        self.updates = state["updates"]

    def fitted_cost(self, states: Trajectories) -> FittedCost:
        """The quadratic cost of the newest latents (section 3)."""
        return fit_quadratic_cost(
            states, self.task.action_cost, self.settings.cost_fit, self.latent
        )

    def _cost_score(self, z: Tensor, episodes: Episodes) -> float:
        return self.fitted_cost(Trajectories.of(z.cpu(), episodes)).r2


def _linear_r2(inputs: NDArray[Any], outputs: NDArray[Any]) -> NDArray[np.float64]:
    """Share of each output column's variance that a linear map of the inputs explains."""
    design = np.column_stack([inputs, np.ones(len(inputs))])
    solution = np.linalg.lstsq(design, outputs, rcond=None)[0]
    residual = outputs - design @ solution
    spread = outputs.var(axis=0)
    return np.where(spread > 1e-12, 1 - residual.var(axis=0) / np.maximum(spread, 1e-12), 1.0)
