"""Networks as a card writes them: a list of layers, each a table with a ``kind``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from solar_cli.settings.schema import Settings, setting


class Unshuffle(Settings):
    """Space to depth: (C, H, W) -> (C f^2, H/f, W/f)."""

    kind: Literal["unshuffle"] = "unshuffle"
    factor: int = setting(..., "side of the blocks that become channels", ge=1)


class Shuffle(Settings):
    """Depth to space, the inverse of unshuffle: (C f^2, H, W) -> (C, H f, W f)."""

    kind: Literal["shuffle"] = "shuffle"
    factor: int = setting(..., "side of the blocks that channels become", ge=1)


class Conv(Settings):
    """A convolution without padding tricks: output side = (side + 2 padding - size)/stride + 1."""

    kind: Literal["conv"] = "conv"
    channels: int = setting(..., "output channels", ge=1)
    size: int = setting(3, "side of the square filter", ge=1)
    stride: int = setting(1, "stride", ge=1)
    padding: int = setting(0, "zeros on every side", ge=0)
    groups: int = setting(1, "independent towers that share no channel", ge=1)
    activation: Literal["relu", "none"] = setting("relu", "what follows")
    pool: int = setting(1, "side of the max-pooling that follows", ge=1)


class SpatialSoftmax(Settings):
    """Expected image coordinates of every channel, in [-1, 1] (Finn et al. 2016)."""

    kind: Literal["spatial_softmax"] = "spatial_softmax"
    log_sharpness: float = setting(
        -3.0, "initial log of the factor on the maps, learned: a soft one reads below a pixel"
    )


class Linear(Settings):
    """A fully connected layer on the flattened input."""

    kind: Literal["linear"] = "linear"
    width: int = setting(..., "outputs", ge=1)
    activation: Literal["relu", "none"] = setting("relu", "what follows")


class Deconv(Settings):
    """A transposed convolution; the first of a list reads a vector as (channels, 1, 1)."""

    kind: Literal["deconv"] = "deconv"
    channels: int = setting(..., "output channels", ge=1)
    size: int = setting(..., "side of the square filter", ge=1)
    stride: int = setting(1, "stride", ge=1)
    activation: Literal["relu", "none"] = setting("relu", "what follows")


class Bumps(Settings):
    """Draw a frame as a sum of Gaussian bumps at coordinates that are linear in the input.

    The decoder's counterpart of a spatial softmax: what it draws moves as its input moves. It is
    the last layer of a list.
    """

    kind: Literal["bumps"] = "bumps"
    points: int = setting(..., "bumps, each with a learned width and a colour", ge=1)
    width: float = setting(0.3, "initial std of a bump; the image is 2 wide", gt=0)


class Maps(Settings):
    """One map for each of some points, a Gaussian bump at coordinates that are linear in the input.

    The spatial softmax read backwards: convolutions that follow draw what stands at the points.
    """

    kind: Literal["maps"] = "maps"
    points: int = setting(..., "maps, each with a bump of a learned width", ge=1)
    factor: int = setting(..., "how many times larger than the maps the frame's sides are", ge=1)
    width: float = setting(0.15, "initial std of a bump; a map is 2 wide", gt=0)


Layer = Annotated[
    Unshuffle | Shuffle | Conv | SpatialSoftmax | Linear | Deconv | Bumps | Maps,
    Field(discriminator="kind"),
]

KEY_POINTS: tuple[Layer, ...] = (
    Unshuffle(factor=4),
    Conv(channels=16, size=3, padding=1),
    Conv(channels=16, size=3, padding=1),
    Conv(channels=32, size=1, activation="none"),
    SpatialSoftmax(),
)
"""Our encoder for every image task: key points of a frame at a quarter of its resolution."""

BUMPS: tuple[Layer, ...] = (Bumps(points=32),)
"""Our decoder for every image task: what moves in a frame, drawn at what moves in the latents."""
