"""Settings of MPC-NN (Nagabandi et al. 2018)."""

from __future__ import annotations

from solar_cli.settings.local import Budget
from solar_cli.settings.neural import NeuralFit
from solar_cli.settings.schema import Settings, setting


class Shooting(Settings):
    """How actions are chosen: a plan costs samples x horizon predictions at every step."""

    samples: int = setting(1000, "action sequences", "their release: 1000 to 5000", ge=1)
    horizon: int = setting(20, "steps ahead", "their release", ge=1)
    noise: float = setting(
        0.005, "std of the noise on collected actions, over the bound", "their release", ge=0
    )


class MpcNn(Settings):
    """Neural dynamics of states, random shooting, the task's own cost."""

    initial: int = setting(10, "episodes of uniform actions", "their release: 10 to 25", ge=2)
    episodes: int = setting(10, "episodes an iteration", "their release", ge=2)
    budget: Budget = setting(Budget(desk=40, full=80), "where to stop", presentation=True)
    network: NeuralFit = setting(
        NeuralFit(
            widths=(500,),
            activation="relu",
            batch=512,
            steps=1000,
            schedule="constant",
            noise=0.01,
            new=0.9,
        ),
        "dynamics",
    )
    shooting: Shooting = setting(Shooting(), "planner")
