"""TRPO (Schulman et al. 2015): sb3-contrib's, on episodes collected side by side."""

from __future__ import annotations

from typing import Any

from sb3_contrib import TRPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from solar_cli.errors import UsageError
from solar_cli.methods.on_policy import OnPolicyLearner
from solar_cli.settings.on_policy import Trpo as TrpoSettings


class Trpo(OnPolicyLearner):
    """TRPO on one cell."""

    settings: TrpoSettings

    def algorithm(self, **shared: Any) -> OnPolicyAlgorithm:
        """As `OnPolicyLearner.algorithm`. Raises `UsageError` where no data is left for a step."""
        settings, horizon = self.settings, self.task.horizon
        if settings.every > settings.rollout * horizon // 2:
            raise UsageError(
                f"every = {settings.every}: a rollout of {settings.rollout} episodes has "
                f"{settings.rollout * horizon} steps, of which a step of the policy needs two at "
                "least; choose less"
            )
        return TRPO(
            target_kl=self.settings.max_kl,
            sub_sampling_factor=self.settings.every,
            cg_max_steps=self.settings.gradients,
            cg_damping=self.settings.damping,
            n_critic_updates=self.settings.value_epochs,
            **shared,
        )
