"""Settings of neural models of dynamics and costs, which two methods plan with."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from solar_cli.settings.schema import Settings, setting


class NeuralFit(Settings):
    """Networks of what an action does, and of what a state costs, and how they are trained."""

    widths: tuple[Annotated[int, Field(ge=1)], ...] = setting((64, 64), "units of hidden layers")
    activation: Literal["relu", "silu"] = setting("silu", "what follows a hidden layer")
    steps: int = setting(1500, "gradient steps an iteration", ge=1)
    batch: int = setting(256, "segments a gradient step", ge=1)
    unroll: int = setting(
        1, "steps of a segment: predictions are fed back, and every step's error counts", ge=1
    )
    learning_rate: float = setting(1e-3, "Adam", gt=0)
    schedule: Literal["cosine", "constant"] = setting(
        "cosine", "of the learning rate, anew in each iteration"
    )
    noise: float = setting(0.0, "noise on inputs and targets, in units of their std", ge=0)
    new: Annotated[float, Field(ge=0, le=1)] | Literal["alike"] = setting(
        "alike", "share of a batch from episodes of the planner; or all segments alike"
    )
    held_out: float = setting(
        0.1, "share of each batch's episodes that choose when to stop", gt=0, lt=1
    )
