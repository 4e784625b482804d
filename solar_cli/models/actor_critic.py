"""Policies of Stable-Baselines3 on a card's layers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Float
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn

from solar_cli.models.networks import build
from solar_cli.settings.on_policy import ActorCritic

CONSTANT = 1e-6
"""What has a smaller std keeps its scale."""
ADAM_EPS = 1e-5
"""Stable-Baselines3's"""
CHUNK = 64
"""windows in floating point at once: bounds memory"""


class Layers(BaseFeaturesExtractor):
    """A card's layers on observations, from which the first ones' mean may be taken.

    Stable-Baselines3 has images in [0, 1] before they come here.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, observation_space: spaces.Box, settings: ActorCritic) -> None:
        shape = observation_space.shape
        body, after = build(settings.layers, shape)
        super().__init__(observation_space, math.prod(after))
        self.body = nn.Sequential(*body, nn.Flatten()) if len(after) > 1 else body
        self.standardises = settings.input == "standardised"
        if self.standardises:
            self.register_buffer("mean", torch.zeros(shape))
            self.register_buffer("scale", torch.ones(shape if len(shape) == 1 else ()))

    def standardise_by(self, windows: NDArray[Any]) -> None:
        """Mean and scale of (n, *shape): of an image one scale, of a state one an entry."""
        largest = 255.0 if windows.dtype == np.uint8 else 1.0
        mean = windows.mean(axis=0, dtype=np.float64)
        chunks = np.array_split(windows, -(-len(windows) // CHUNK))
        variance = sum(np.square(chunk - mean).sum(axis=0) for chunk in chunks) / len(windows)
        if largest > 1.0:  # an entry of a state has a unit of its own, a pixel has not
            variance = variance.mean()
        scale = np.sqrt(variance) / largest
        self.mean.copy_(torch.from_numpy(mean / largest))
        self.scale.copy_(torch.as_tensor(np.where(scale > CONSTANT, scale, 1.0)))

    def forward(self, observations: Float[Tensor, "n *shape"]) -> Float[Tensor, "n m"]:
        """What is read from them."""
        if self.standardises:
            observations = (observations - self.mean) / self.scale
        features: Tensor = self.body(observations)
        return features


class ActorCriticOfLayers(ActorCriticPolicy):
    """Stable-Baselines3's policy and value, as a card describes them, for actions in [-1, 1]."""

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        settings: ActorCritic,
        use_sde: bool = False,
    ) -> None:
        heads = list(settings.heads)
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch={"pi": heads, "vf": heads},
            log_std_init=math.log(settings.std),
            features_extractor_class=Layers,
            features_extractor_kwargs={"settings": settings},
            share_features_extractor=settings.shared,
            optimizer_kwargs={"eps": ADAM_EPS, "fused": True},
            use_sde=use_sde,  # which Stable-Baselines3 always passes on
        )

    def extract_features(self, obs: Any, features_extractor: Any = None) -> Any:
        """As Stable-Baselines3's; where there are two, an observation is converted once."""
        if self.share_features_extractor or features_extractor is not None:
            return super().extract_features(obs, features_extractor)
        seen = preprocess_obs(obs, self.observation_space, self.normalize_images)
        return self.pi_features_extractor(seen), self.vf_features_extractor(seen)

    def mean_and_value(
        self, observations: Float[Tensor, "n *shape"]
    ) -> tuple[Float[Tensor, "n a"], Float[Tensor, "n 1"]]:
        """The mean action, and the expected return."""
        features = self.extract_features(observations)
        if self.share_features_extractor:
            of_policy, of_value = self.mlp_extractor(features)
        else:
            of_policy = self.mlp_extractor.forward_actor(features[0])
            of_value = self.mlp_extractor.forward_critic(features[1])
        return self.action_net(of_policy), self.value_net(of_value)

    @property
    def standardises(self) -> bool:
        """Whether the card says so."""
        return any(isinstance(part, Layers) and part.standardises for part in self.modules())

    def standardise_by(self, windows: NDArray[Any]) -> None:
        """Take mean and scale from observations (n, *shape)."""
        for part in self.modules():
            if isinstance(part, Layers):
                part.standardise_by(windows)
