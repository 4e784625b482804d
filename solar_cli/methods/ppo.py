"""PPO (Schulman et al. 2017): Stable-Baselines3's, on episodes collected side by side."""

from __future__ import annotations

from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from solar_cli.methods.on_policy import OnPolicyLearner
from solar_cli.settings.on_policy import Ppo as PpoSettings


class Ppo(OnPolicyLearner):
    """PPO on one cell."""

    settings: PpoSettings

    def algorithm(self, **shared: Any) -> OnPolicyAlgorithm:
        """As `OnPolicyLearner.algorithm`."""
        stop = self.settings.stop_kl
        return PPO(
            target_kl=None if stop == "never" else stop,
            n_epochs=self.settings.epochs,
            clip_range=self.settings.clip,
            ent_coef=self.settings.entropy,
            vf_coef=self.settings.value_weight,
            max_grad_norm=self.settings.largest_gradient,
            **shared,
        )
