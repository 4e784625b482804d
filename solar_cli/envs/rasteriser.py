"""Drawing without a graphics library: shapes whose pixels follow from a formula.

Pixel (r, c) is the point with row coordinate r and column coordinate c; row 0 is at the top.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

PEAK = 255.0
"""brightness at the centre of a blob"""


def draw_blobs(images: NDArray[np.uint8], centres: NDArray[np.float64], deviation: float) -> None:
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


def _profiles(
    centres: NDArray[np.float64], pixels: int, deviation: float
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Bell curves along an axis of ``pixels``: first pixel (N,), values (N, size) from there on.

    Pixels that are left out would round to zero, or lie outside the image.
    """
    reach = math.ceil(deviation * math.sqrt(2.0 * math.log(2.0 * PEAK)))  # half a grey level
    size = min(2 * reach, pixels)
    lowest = np.floor(centres).astype(np.intp) - (reach - 1)
    first = np.minimum(np.maximum(lowest, 0), pixels - size)
    offsets = (first - centres)[:, None] + np.arange(size)
    return first, np.exp(offsets * offsets * (-0.5 / deviation**2))


def shrink(images: NDArray[np.float64], rows: int, columns: int) -> NDArray[np.float64]:
    """Images (..., H, W) as (..., rows, columns): each pixel is the mean of the area it covers."""
    down, across = _areas(images.shape[-2], rows), _areas(images.shape[-1], columns)
    return np.asarray(down @ images @ across.T)


def _areas(size: int, pixels: int) -> NDArray[np.float64]:
    """(pixels, size) share of each old pixel in each new one; each row sums to one."""
    edges, old = np.arange(pixels + 1)[:, None] * size / pixels, np.arange(size)
    covered = np.minimum(edges[1:], old + 1) - np.maximum(edges[:-1], old)
    return np.asarray(np.maximum(covered, 0.0) * pixels / size)


def enlarge(images: NDArray[np.float64], factor: int) -> NDArray[np.float64]:
    """Images (..., H, W) at ``factor`` times the resolution, (..., H factor, W factor).

    Smooth cubic interpolation through the pixel centres (Catmull-Rom), for people to look at: it
    may leave the range of the pixels by a little. Beyond the outermost centres the border goes on.
    """
    rows, columns = (_interpolation(size, factor) for size in images.shape[-2:])
    return np.asarray(rows @ images @ columns.T)


def _interpolation(size: int, factor: int) -> NDArray[np.float64]:
    """(size factor, size) weights of cubic interpolation; each row sums to one."""
    places = np.clip((np.arange(size * factor) + 0.5) / factor - 0.5, 0, size - 1)
    d = np.abs(places[:, None] - np.arange(size))
    near, far = (1.5 * d - 2.5) * d * d + 1.0, ((2.5 - 0.5 * d) * d - 4.0) * d + 2.0
    weights = np.where(d < 1.0, near, np.where(d < 2.0, far, 0.0))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
