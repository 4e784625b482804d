"""Settings of the model-free methods on policy: PPO and TRPO."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from solar_cli.settings.local import Budget
from solar_cli.settings.networks import Layer
from solar_cli.settings.networks import Linear as LinearLayer
from solar_cli.settings.schema import Settings, setting


class ActorCritic(Settings):
    """A Gaussian policy whose mean, and a value, are read from layers on the observation."""

    layers: tuple[Layer, ...] = setting(
        (LinearLayer(width=64),), "layers on the window's stacked frames", min_length=1
    )
    input: Literal["standardised", "unit"] = setting(
        "standardised", "by the first rollout's mean and std; or images in [0, 1], states as seen"
    )
    heads: tuple[int, ...] = setting((64,), "tanh units above them, of the mean and of the value")
    shared: bool = setting(
        False, "mean and value are read from the same layers, or each from its own"
    )
    std: float = setting(0.5, "initial std of every action entry, over the bound", gt=0)


class OnPolicy(Settings):
    """What PPO and TRPO share; where no source is given, values are ours."""

    rollout: int = setting(50, "episodes collected for one update", ge=1)
    evaluations: int = setting(
        20, "evaluations in a decade of episodes: evenly on a logarithmic axis", ge=1
    )
    budget: Budget = setting(..., "where to stop", presentation=True)
    network: ActorCritic = setting(ActorCritic(), "policy and value")
    reward_scale: float = setting(1.0, "the reward is minus the cost, times this", gt=0)
    learning_rate: float = setting(1e-3, "Adam, at the start", gt=0)
    horizon: int = setting(..., "episodes over which the learning rate falls, linearly", ge=1)
    discount: float = setting(0.95, "gamma", gt=0, le=1)
    gae_lambda: float = setting(0.9, "lambda of generalised advantage estimation", ge=0, le=1)
    minibatch: int = setting(800, "steps of a gradient step", ge=2)


class Ppo(OnPolicy):
    """PPO (Schulman et al. 2017)."""

    epochs: int = setting(4, "passes over a rollout", ge=1)
    stop_kl: Annotated[float, Field(gt=0)] | Literal["never"] = setting(
        0.02, "nats after which an update takes no further step (Stable-Baselines3's target_kl)"
    )
    clip: float = setting(0.2, "of the likelihood ratio", "Stable-Baselines3", gt=0)
    entropy: float = setting(0.0, "weight of the entropy", "Stable-Baselines3", ge=0)
    value_weight: float = setting(0.5, "weight of the value's loss", "Stable-Baselines3", ge=0)
    largest_gradient: float = setting(0.5, "its norm is clipped to", "Stable-Baselines3", gt=0)


class Trpo(OnPolicy):
    """TRPO (Schulman et al. 2015)."""

    max_kl: float = setting(0.01, "nats that a policy may move in an update", "sb3-contrib", gt=0)
    every: int = setting(4, "the policy's step is computed on every so many steps' data", ge=1)
    gradients: int = setting(10, "conjugate-gradient iterations", ge=1)
    damping: float = setting(0.1, "of the Fisher matrix", "sb3-contrib", ge=0)
    value_epochs: int = setting(10, "passes of the value over a rollout", "sb3-contrib", ge=1)
