"""What a card's ``[task]`` and ``[evaluation]`` tables may say."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from solar_cli.settings.schema import Settings, setting


class Observation(Settings):
    """What a learner sees at one time step."""

    kind: Literal["image", "state"] = setting("image", "pixels, or a vector of numbers")
    height: int = setting(1, "rows of an image in pixels", ge=1)
    width: int = setting(1, "columns of an image in pixels; entries of a state", ge=1)
    channels: int = setting(1, "channels of one frame", ge=1)
    window: int = setting(1, "frames an observation holds: this one and those before", ge=1, le=16)

    @model_validator(mode="after")
    def _an_image_has_a_size(self) -> Self:
        if self.kind == "image" and not {"height", "width"} <= self.model_fields_set:
            raise ValueError("an image needs height and width")
        return self

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """Shape of one frame: (C, H, W) for an image, (S,) for a state."""
        if self.kind == "image":
            return (self.channels, self.height, self.width)
        return (self.width,)


class Action(Settings):
    """The action space: a box, symmetric around zero."""

    size: int = setting(..., "entries of an action", ge=1)
    bound: float = setting(..., "largest absolute value of an entry; larger is clipped", gt=0)


class Exploration(Settings):
    """Noise of the first policy, which is zero-mean."""

    std: float = setting(..., "standard deviation of every action entry", gt=0)
    smoothing: float = setting(
        0.0, "Gaussian smoothing of the noise over time, in steps; its std is kept", ge=0
    )


class TaskSettings(Settings):
    """An episodic control problem with a fixed horizon."""

    simulator: str = setting(..., "name of the simulator that runs the task")
    parameters: dict[str, Any] = setting({}, "what the simulator is told, by its own names")
    horizon: int = setting(..., "actions an episode has: T", ge=1)
    step_seconds: float = setting(1.0, "simulated time of one step in seconds", gt=0)
    observation: Observation = setting(..., "what a learner sees")
    action: Action = setting(..., "what a learner does")
    exploration: Exploration = setting(..., "noise of the first policy")
    action_cost: float = setting(
        0.0, "alpha: the known weight of |a|^2 in the cost", "section 3", ge=0
    )


class EvaluationSettings(Settings):
    """Fresh episodes of the noise-free policy, and how the report reads them."""

    episodes: int = setting(100, "episodes an evaluation has", ge=1)
    headline: str = setting("return", "the measure that the report shows", presentation=True)
    better: Literal["lower", "higher"] = setting(
        "higher", "which end of the headline measure is good", presentation=True
    )
    unit: str = setting("", "unit of the headline measure", presentation=True)
    levels: tuple[float, ...] = setting(
        (), "levels for 'episodes to reach', committed before the runs", presentation=True
    )
    milestones: tuple[Annotated[int, Field(ge=1)], ...] = setting(
        (), "episodes from which on the first checkpoint is kept for good", presentation=True
    )
