"""Torch modules from a card's layer list (`solar_cli.settings.networks`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from solar_cli.errors import UsageError
from solar_cli.settings.networks import (
    Bumps,
    Conv,
    Deconv,
    Layer,
    Linear,
    Maps,
    Shuffle,
    SpatialSoftmax,
    Unshuffle,
)

Shape = tuple[int, ...]

LARGEST_LAYER = 10**8
"""Weights of a layer, and its outputs for one frame: a slip of the pen must not fill the memory."""
LOG_SPEED = 5.0
"""Adam moves a parameter by at most its learning rate a step: too little for the log of a width,
which has to change by whole units within a training. It is held divided by this."""


class SpatialSoftmaxLayer(nn.Module):
    """Expected coordinates (x, y) in [-1, 1] of each channel under a softmax over its pixels.

    Finn et al. 2016, deep spatial auto-encoders, with a learned sharpness.
    """

    places: Tensor

    def __init__(self, height: int, width: int, log_sharpness: float) -> None:
        super().__init__()
        self.log_sharpness = nn.Parameter(torch.tensor(log_sharpness))
        rows, columns = torch.linspace(1, -1, height), torch.linspace(-1, 1, width)
        places = torch.cartesian_prod(rows, columns).flip(-1)
        self.register_buffer("places", places, persistent=False)

    def forward(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n two_c"]:
        """Coordinates of all channels: x of each, then y of each (up is positive)."""
        share = (maps.flatten(2) * self.log_sharpness.exp()).softmax(dim=-1)
        return (share @ self.places).mT.flatten(1)


class _Points(nn.Module):
    """Gaussian bumps at coordinates (x, y) in [-1, 1] that are linear in the input."""

    columns: Tensor
    rows: Tensor

    def __init__(self, inputs: int, points: int, sides: Shape, width: float) -> None:
        super().__init__()
        height, columns = sides
        self.place = nn.Linear(inputs, 2 * points)
        nn.init.uniform_(self.place.bias, -0.5, 0.5)
        self.log_width = nn.Parameter(torch.full((points,), math.log(width) / LOG_SPEED))
        self.register_buffer("columns", torch.linspace(-1, 1, columns), persistent=False)
        self.register_buffer("rows", torch.linspace(1, -1, height), persistent=False)

    def bumps(
        self, inputs: Float[Tensor, "n m"]
    ) -> tuple[Float[Tensor, "n points h"], Float[Tensor, "n points w"]]:
        """Down and across: a bump is their outer product."""
        x, y = self.place(inputs).chunk(2, dim=-1)
        scale = (-LOG_SPEED * self.log_width).exp()[:, None]
        across = (-0.5 * ((self.columns - x.unsqueeze(-1)) * scale).square()).exp()
        down = (-0.5 * ((self.rows - y.unsqueeze(-1)) * scale).square()).exp()
        return down, across


class BumpsLayer(_Points):
    """A frame as a coloured sum of the bumps."""

    def __init__(self, inputs: int, points: int, frame: Shape, width: float) -> None:
        super().__init__(inputs, points, frame[1:], width)
        self.colour = nn.Parameter(torch.randn(frame[0], points) / math.sqrt(points))
        self.ground = nn.Parameter(torch.zeros(frame[0], 1, 1))

    def forward(self, inputs: Float[Tensor, "n m"]) -> Float[Tensor, "n c h w"]:
        """Sum over points of colour x down x across: the maps of single bumps are never made."""
        down, across = self.bumps(inputs)
        painted = self.colour[:, :, None] * down.unsqueeze(1)
        frame: Tensor = painted.mT @ across.unsqueeze(1) + self.ground
        return frame


class MapsLayer(_Points):
    """A map for each of the bumps."""

    def forward(self, inputs: Float[Tensor, "n m"]) -> Float[Tensor, "n points h w"]:
        """Down x across."""
        down, across = self.bumps(inputs)
        return down.unsqueeze(-1) * across.unsqueeze(-2)


def build(layers: Sequence[Layer], shape: Shape, frame: Shape = ()) -> tuple[nn.Sequential, Shape]:
    """The network and its output shape for inputs of ``shape`` (without the batch axis).

    ``frame`` is the shape of the frames that a decoder draws.
    Raises `UsageError` where a layer does not fit what comes before it.
    """
    modules: list[nn.Module] = []
    for number, layer in enumerate(layers, 1):
        try:
            _require_bounded("weights", _weights(layer, shape))
            added, after = _layer(layer, shape, frame)
            _require_bounded("outputs", math.prod(after))
        except (ValueError, ZeroDivisionError) as error:
            raise UsageError(
                f"layer {number} ({layer.kind}) does not fit an input of shape {shape}: {error}; "
                "correct the card's layer list"
            ) from error
        modules += added
        shape = after
    return nn.Sequential(*modules), shape


def perceptron(
    inputs: int,
    hidden: Sequence[int],
    outputs: int,
    activation: Callable[[], nn.Module] = nn.ReLU,
) -> nn.Sequential:
    """Fully connected layers, with an activation after each but the last."""
    layers: list[nn.Module] = []
    for before, after in pairwise((inputs, *hidden)):
        layers += [nn.Linear(before, after), activation()]
    return nn.Sequential(*layers, nn.Linear((inputs, *hidden)[-1], outputs))


def _weights(layer: Layer, shape: Shape) -> int:
    """Entries of the layer's matrix or filters for inputs of ``shape``."""
    if isinstance(layer, Linear):
        return math.prod(shape) * layer.width
    if isinstance(layer, Conv):
        return shape[0] // layer.groups * layer.channels * layer.size**2
    if isinstance(layer, Deconv):
        return shape[0] * layer.channels * layer.size**2
    return shape[0] * 2 * layer.points if isinstance(layer, Bumps | Maps) else 0


def _require_bounded(what: str, count: int) -> None:
    if count > LARGEST_LAYER:
        raise ValueError(f"it has {count} {what}, more than {LARGEST_LAYER}")


def _layer(layer: Layer, shape: Shape, frame: Shape) -> tuple[list[nn.Module], Shape]:
    if isinstance(layer, Linear):
        width = math.prod(shape)
        flatten = [nn.Flatten()] if len(shape) > 1 else []
        linear = nn.Linear(width, layer.width)
        return [*flatten, linear, *_activation(layer.activation)], (layer.width,)
    if isinstance(layer, Bumps):
        if len(shape) != 1 or len(frame) != 3:
            raise ValueError("it needs a vector, and images to draw")
        return [BumpsLayer(shape[0], layer.points, frame, layer.width)], frame
    if isinstance(layer, Maps):
        if len(shape) != 1 or len(frame) != 3:
            raise ValueError("it needs a vector, and images to draw")
        sides = _divided(frame[1:], layer.factor)
        return [MapsLayer(shape[0], layer.points, sides, layer.width)], (layer.points, *sides)
    if isinstance(layer, Deconv) and len(shape) == 1:
        shape = (shape[0], 1, 1)
        added, shape = _image_layer(layer, shape)
        return [nn.Unflatten(1, (-1, 1, 1)), *added], shape
    if len(shape) != 3:
        raise ValueError("it needs an image (C, H, W)")
    return _image_layer(layer, shape)


def _image_layer(layer: Layer, shape: Shape) -> tuple[list[nn.Module], Shape]:
    channels, height, width = shape
    if isinstance(layer, Unshuffle):
        sides = _divided((height, width), layer.factor)
        return [nn.PixelUnshuffle(layer.factor)], (channels * layer.factor**2, *sides)
    if isinstance(layer, Shuffle):
        if channels % layer.factor**2:
            raise ValueError(f"channels are no multiple of {layer.factor**2}")
        sides = (height * layer.factor, width * layer.factor)
        return [nn.PixelShuffle(layer.factor)], (channels // layer.factor**2, *sides)
    if isinstance(layer, SpatialSoftmax):
        return [SpatialSoftmaxLayer(height, width, layer.log_sharpness)], (2 * channels,)
    if isinstance(layer, Deconv):
        deconv = nn.ConvTranspose2d(channels, layer.channels, layer.size, layer.stride)
        larger = [(side - 1) * layer.stride + layer.size for side in (height, width)]
        return [deconv, *_activation(layer.activation)], (layer.channels, *larger)
    assert isinstance(layer, Conv)
    if channels % layer.groups or layer.channels % layer.groups:
        raise ValueError(f"channels are no multiples of {layer.groups} groups")
    after = [
        ((side + 2 * layer.padding - layer.size) // layer.stride + 1) // layer.pool
        for side in (height, width)
    ]
    if min(after) < 1:
        raise ValueError("nothing is left of the image")
    conv = nn.Conv2d(
        channels, layer.channels, layer.size, layer.stride, layer.padding, groups=layer.groups
    )
    pool = [nn.MaxPool2d(layer.pool)] if layer.pool > 1 else []
    return [conv, *_activation(layer.activation), *pool], (layer.channels, *after)


def _divided(sides: Shape, factor: int) -> Shape:
    if any(side % factor for side in sides):
        raise ValueError(f"sides are no multiples of {factor}")
    return tuple(side // factor for side in sides)


def _activation(name: str) -> list[nn.Module]:
    return [nn.ReLU()] if name == "relu" else []
