"""Settings of MPC-NN (Nagabandi et al. 2018)."""

from __future__ import annotations

from solar_cli.settings.local import Budget
from solar_cli.settings.schema import Settings, setting


class NetworkFit(Settings):
    """How a dynamics network is trained."""

    width: int = setting(500, "units of the hidden layer", "their release", ge=1)
    learning_rate: float = setting(1e-3, "Adam", "their release", gt=0)
    batch: int = setting(512, "transitions a gradient step", "their release", ge=1)
    epochs: int = setting(60, "passes over the data an iteration", "their release: 30 to 60", ge=1)
    noise: float = setting(
        0.01, "noise on inputs and targets, in units of their std", "their release", ge=0
    )
    new: float = setting(
        0.9, "share of a batch from episodes of the planner", "their release", ge=0, le=1
    )


class Shooting(Settings):
    """How actions are chosen."""

    samples: int = setting(1000, "action sequences", "their release: 1000 to 5000", ge=1)
    horizon: int = setting(20, "steps ahead", "their release", ge=1)
    noise: float = setting(
        0.005, "std of the noise on collected actions, over the bound", "their release", ge=0
    )


class MpcNn(Settings):
    """Neural dynamics of states, random shooting, the task's own cost."""

    initial: int = setting(10, "episodes of exploration noise", "their release: 10 to 25", ge=1)
    episodes: int = setting(10, "episodes an iteration", "their release", ge=1)
    budget: Budget = setting(Budget(desk=40, full=80), "where to stop", presentation=True)
    network: NetworkFit = setting(NetworkFit(), "dynamics")
    shooting: Shooting = setting(Shooting(), "planner")
