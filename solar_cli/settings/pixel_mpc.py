"""Settings of the pixel-space model (after Finn and Levine 2017)."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from solar_cli.settings.local import Budget
from solar_cli.settings.networks import Conv, Layer, SpatialSoftmax, Unshuffle
from solar_cli.settings.schema import Settings, setting

PIXEL_FEATURES: tuple[Layer, ...] = (
    Unshuffle(factor=2),
    Conv(channels=16, size=3, padding=1),
    Conv(channels=16, size=3, padding=1),
    Conv(channels=32, size=1, activation="none"),
    SpatialSoftmax(log_sharpness=0.0),
)
"""What motion and cost are read from: key points of a pooled frame at half of its resolution."""


class Video(Settings):
    """The model of frames and costs."""

    pool: int = setting(2, "side of the blocks of pixels whose mean is predicted", ge=1)
    layers: int = setting(4, "parts of a frame that move, each by a distance of its own", ge=1)
    features: tuple[Layer, ...] = setting(
        PIXEL_FEATURES, "network on each frame, seen or predicted, that motion and cost read"
    )
    mask_channels: int = setting(16, "channels of the network that parts a frame in layers", ge=1)
    width: int = setting(64, "units of the hidden layers of motion and cost", ge=1)


class VideoTraining(Settings):
    """Descent on the errors of predicted frames and costs."""

    steps: int = setting(2000, "gradient steps of the first training", ge=1)
    later_steps: int = setting(500, "gradient steps of each later one", ge=1)
    clips: int = setting(32, "clips of consecutive frames a step", ge=1)
    learning_rate: float = setting(3e-3, "Adam, falling along a cosine", gt=0)
    later_rate: float = setting(1e-3, "the same, of each later training", gt=0)
    clip: float = setting(1.0, "largest norm of the gradient", gt=0)


class Planner(Settings):
    """Model-predictive control by the cross-entropy method, anew at every step."""

    horizon: int = setting(6, "steps that are predicted, in training too", ge=1)
    repeat: int = setting(1, "steps that each action of a plan is held for", ge=1)
    samples: int = setting(64, "action sequences an iteration", ge=2)
    iterations: int = setting(3, "refits of their distribution", ge=1)
    elites: int = setting(8, "sequences of least cost that it is refitted to", ge=1)
    std: float = setting(2.0, "of the first sequences, over that of exploration", gt=0)
    least_std: float = setting(0.1, "least std of the later ones, over that of exploration", ge=0)
    noise: float = setting(1.0, "std of noise on collected actions, over that of exploration", ge=0)

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.elites > self.samples:
            raise ValueError("elites: more than samples")
        return self


class PixelMpc(Settings):
    """Prediction of frames and costs, and planning on them."""

    initial: int = setting(100, "episodes of exploration noise before the first model", ge=1)
    episodes: int = setting(20, "episodes an iteration collects", ge=1)
    budget: Budget = setting(Budget(desk=240, full=400), "where to stop", presentation=True)
    video: Video = setting(Video(), "networks")
    training: VideoTraining = setting(VideoTraining(), "of the networks")
    planner: Planner = setting(Planner(), "how actions are chosen")
