"""Drawing without a graphics library: shapes whose pixels follow from a formula.

Pixel (r, c) is the point with row coordinate r and column coordinate c; row 0 is at the top.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

PEAK = 255.0
"""brightness at the centre of a blob"""
CHUNK_PIXELS = 15_000
"""pixels of figures drawn at once: temporaries below 128 KiB, which malloc keeps in its heap"""


def draw_blobs(images: NDArray[np.uint8], centres: Floats, deviation: float) -> None:
    """Draw a Gaussian blob into each black image (N, H, W), in place.

    ``centres`` (N, 2) are (row, column) in pixels, ``deviation`` is the blob's standard deviation
    in pixels. A pixel at distance d gets 255 exp(-d^2 / (2 deviation^2)), rounded. A blob may lie
    partly or wholly outside its image.
    """
    top, down = _profiles(centres[:, 0], images.shape[1], deviation)
    left, across = _profiles(centres[:, 1], images.shape[2], deviation)
    patches = np.rint(PEAK * down[:, :, None] * across[:, None, :]).astype(np.uint8)
    windows = np.lib.stride_tricks.sliding_window_view(
        images, patches.shape[1:], axis=(1, 2), writeable=True
    )
    windows[np.arange(len(images)), top, left] = patches


def _profiles(centres: Floats, pixels: int, deviation: float) -> tuple[NDArray[np.intp], Floats]:
    """Bell curves along an axis of ``pixels``: first pixel (N,), values (N, size) from there on.

    Pixels that are left out would round to zero, or lie outside the image.
    """
    reach = math.ceil(deviation * math.sqrt(2.0 * math.log(2.0 * PEAK)))  # half a grey level
    size = min(2 * reach, pixels)
    lowest = np.floor(centres).astype(np.intp) - (reach - 1)
    first = np.minimum(np.maximum(lowest, 0), pixels - size)
    offsets = (first - centres)[:, None] + np.arange(size)
    return first, np.exp(offsets * offsets * (-0.5 / deviation**2))


class Box(NamedTuple):
    """A filled rectangle of a figure; lengths in pixels when it is drawn."""

    centre: tuple[float, float]
    """ahead of the figure's centre, and to its left"""
    half: tuple[float, float]
    """half of its length, and of its width"""
    grey: float
    """0 to 255"""

    @property
    def reach(self) -> float:
        """No pixel farther than this from the figure's centre shows it."""
        sides = zip(self.centre, self.half, strict=True)
        return math.hypot(*(abs(centre) + half + 0.5 for centre, half in sides))

    def scaled(self, factor: float) -> Box:
        """The same with every length times ``factor``."""
        (ahead, left), (long, wide) = self.centre, self.half
        return Box((factor * ahead, factor * left), (factor * long, factor * wide), self.grey)

    def coverage(self, ahead: Floats, left: Floats) -> Floats:
        """Share of each pixel that it covers: exact where its sides follow the pixels."""
        return _overlap(ahead - self.centre[0], self.half[0]) * _overlap(
            left - self.centre[1], self.half[1]
        )


class Disc(NamedTuple):
    """A filled circle of a figure; lengths in pixels when it is drawn."""

    centre: tuple[float, float]
    """ahead of the figure's centre, and to its left"""
    radius: float
    grey: float
    """0 to 255"""

    @property
    def reach(self) -> float:
        """No pixel farther than this from the figure's centre shows it."""
        return math.hypot(*self.centre) + self.radius + 0.5

    def scaled(self, factor: float) -> Disc:
        """The same with every length times ``factor``."""
        ahead, left = self.centre
        return Disc((factor * ahead, factor * left), factor * self.radius, self.grey)

    def coverage(self, ahead: Floats, left: Floats) -> Floats:
        """Share of each pixel that it covers, from the distance to its edge."""
        ahead, left = ahead - self.centre[0], left - self.centre[1]
        inside = self.radius + 0.5 - np.sqrt(ahead * ahead + left * left)
        return np.minimum(np.maximum(inside, 0.0), 1.0)


def draw_figure(
    images: NDArray[np.uint8], centres: Floats, headings: Floats, figure: Sequence[Box | Disc]
) -> None:
    """Draw a rigid figure onto each image (N, H, W), in place: its parts one over the other.

    ``centres`` (N, 2) are (row, column) in pixels. ``headings`` (N,) in radians turn what is ahead
    from right (0) to up (pi/2). Edges are smooth: a pixel takes a part's grey by the share of it
    that the part covers. Pixels out of reach stay as they are; a figure may lie partly or wholly
    outside its image.
    """
    reach = max(part.reach for part in figure)
    size = math.floor(2.0 * reach) + 1
    # Temporaries that stay in the cache, and below what malloc asks the system for.
    some = max(1, CHUNK_PIXELS // size**2)
    for start in range(0, len(images), some):
        chunk = slice(start, start + some)
        _draw_figure(images[chunk], centres[chunk], headings[chunk], figure, reach, size)


def _draw_figure(
    images: NDArray[np.uint8],
    centres: Floats,
    headings: Floats,
    figure: Sequence[Box | Disc],
    reach: float,
    size: int,
) -> None:
    top, rows = _places(centres[:, 0], reach, size, images.shape[1])
    left, columns = _places(centres[:, 1], reach, size, images.shape[2])
    windows = np.lib.stride_tricks.sliding_window_view(
        images, (rows.shape[1], columns.shape[1]), axis=(1, 2), writeable=True
    )
    patch = np.arange(len(images)), top, left
    down, across = rows[:, :, None], columns[:, None, :]
    cos, sin = np.cos(headings)[:, None, None], np.sin(headings)[:, None, None]
    ahead, leftwards = across * cos - down * sin, -across * sin - down * cos
    pixels = windows[patch].astype(np.float64)
    for part in figure:
        pixels += part.coverage(ahead, leftwards) * (part.grey - pixels)
    windows[patch] = np.rint(pixels).astype(np.uint8)


def _places(
    centres: Floats, reach: float, size: int, pixels: int
) -> tuple[NDArray[np.intp], Floats]:
    """First pixel (N,) within reach, and from there on each one's place, seen from the centre.

    Written as pixel minus centre, so that a place does not depend on where a patch begins.
    """
    size = min(size, pixels)
    lowest = np.ceil(centres - reach).astype(np.intp)
    first = np.minimum(np.maximum(lowest, 0), pixels - size)
    return first, (first[:, None] + np.arange(size)) - centres[:, None]


def _overlap(places: Floats, half: float) -> Floats:
    """Length of what a pixel at each place shares with the interval +-half."""
    return np.minimum(np.maximum(half + 0.5 - np.abs(places), 0.0), min(1.0, 2.0 * half))


def shrink(images: Floats, rows: int, columns: int) -> Floats:
    """Images (..., H, W) as (..., rows, columns): each pixel is the mean of the area it covers."""
    down, across = _areas(images.shape[-2], rows), _areas(images.shape[-1], columns)
    return np.asarray(down @ images @ across.T)


def _areas(size: int, pixels: int) -> Floats:
    """(pixels, size) share of each old pixel in each new one; each row sums to one."""
    edges, old = np.arange(pixels + 1)[:, None] * size / pixels, np.arange(size)
    covered = np.minimum(edges[1:], old + 1) - np.maximum(edges[:-1], old)
    return np.asarray(np.maximum(covered, 0.0) * pixels / size)


def enlarge(images: Floats, factor: int) -> Floats:
    """Images (..., H, W) at ``factor`` times the resolution, (..., H factor, W factor).

    Smooth cubic interpolation through the pixel centres (Catmull-Rom), for people to look at: it
    may leave the range of the pixels by a little. Beyond the outermost centres the border goes on.
    """
    rows, columns = (_interpolation(size, factor) for size in images.shape[-2:])
    return np.asarray(rows @ images @ columns.T)


def _interpolation(size: int, factor: int) -> Floats:
    """(size factor, size) weights of cubic interpolation; each row sums to one."""
    places = np.clip((np.arange(size * factor) + 0.5) / factor - 0.5, 0, size - 1)
    d = np.abs(places[:, None] - np.arange(size))
    near, far = (1.5 * d - 2.5) * d * d + 1.0, ((2.5 - 0.5 * d) * d - 4.0) * d + 2.0
    weights = np.where(d < 1.0, near, np.where(d < 2.0, far, 0.0))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
