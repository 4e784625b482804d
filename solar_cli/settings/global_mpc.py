"""Settings of the global-model ablation (section 6)."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from solar_cli.settings.local import Dynamics, LatentMethod
from solar_cli.settings.neural import NeuralFit
from solar_cli.settings.schema import Settings, setting


class CrossEntropy(Settings):
    """How actions are chosen: a plan costs samples x iterations x horizon predictions a step."""

    horizon: int = setting(10, "steps ahead; the authors' release: 20", ge=1)
    samples: int = setting(200, "action sequences an iteration; the release: 1024", ge=2)
    iterations: int = setting(4, "refits of their distribution; the release: 10", ge=1)
    elites: int = setting(20, "sequences that it is refitted to; the release: 15", ge=1)
    std: float = setting(0.3, "first std of an entry, over the bound; the release: 0.2", gt=0)
    least_std: float = setting(0.01, "least std of an entry, over the bound", ge=0)
    mean: tuple[float, ...] = setting(
        (),
        "of each entry of an action that is not planned yet, over the bound; () is zero. Section "
        "6.2 has positive accelerations for the car",
    )
    noise: float = setting(
        0.5, "std of the noise on collected actions, over that of exploration", ge=0
    )

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.elites > self.samples:
            raise ValueError("elites: more than samples")
        return self


class GlobalMpc(LatentMethod):
    """SOLAR's representation, neural models of dynamics and cost on it, and planning."""

    dynamics: Dynamics = setting(Dynamics(), "the representation's prior over latent dynamics")
    network: NeuralFit = setting(
        NeuralFit(unroll=3), "dynamics and cost of latent states, one network each"
    )
    planner: CrossEntropy = setting(CrossEntropy(), "the cross-entropy method")
