"""Pictures for people from a cell's artifacts: the policy at work, and what its model sees."""

from __future__ import annotations

import hashlib
import io
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from solar_cli.envs import picture
from solar_cli.errors import SolarError
from solar_cli.settings import TaskSettings
from solar_cli.store.records import ArtifactRecord

Pictures = NDArray[np.uint8]

SIDE = 160
"""Least height of one frame on the screen, in pixels."""
GAP = 8
"""White pixels between frames that stand side by side."""
EPISODES = 4
"""Episodes of an animation, side by side."""
FRAME_MILLISECONDS = 80
PALETTE_FRAMES = 5
"""Frames, about, that an animation's colours are taken from."""
LAST_MILLISECONDS = 1200
"""The end is what counts: it stays."""
RESTORE = "put the cell's files beside the database; its numbers are all here"


def arrays(artifact: ArtifactRecord) -> dict[str, NDArray[Any]]:
    """The arrays of an ``.npz`` artifact, unpickled never.

    Raises `SolarError` for a file that is missing, or not as it was stored; without its folder, as
    a report is made to be passed on.
    """
    name = f"{artifact.path.name} of cell {artifact.cell[:8]}"
    try:
        content = artifact.path.read_bytes()
        if hashlib.sha256(content).hexdigest() != artifact.sha256:
            raise ValueError("its SHA-256 is not the stored one")
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except OSError as error:
        cause = error.strerror or type(error).__name__
        raise SolarError(f"{name} cannot be read ({cause}): {RESTORE}") from error
    except (ValueError, EOFError) as error:
        raise SolarError(f"{name} is damaged ({error}): {RESTORE}") from error


def animation(settings: TaskSettings, frames: NDArray[Any]) -> bytes:
    """An endless GIF of a few episodes side by side; ``frames`` (K, T+1, C, H, W) uint8."""
    shown = _side_by_side(_enlarged(settings, frames[:EPISODES]))
    # One palette, from frames of the whole episode: nothing flickers.
    some = np.concatenate(shown[:: max(1, len(shown) // PALETTE_FRAMES)])
    palette = Image.fromarray(some).quantize(colors=128)
    images = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in shown
    ]
    file = io.BytesIO()
    images[0].save(
        file,
        format="GIF",
        save_all=True,
        append_images=images[1:],
        duration=[FRAME_MILLISECONDS] * (len(images) - 1) + [LAST_MILLISECONDS],
        loop=0,
        optimize=False,
    )
    return file.getvalue()


def reconstructions(
    settings: TaskSettings, original: NDArray[Any], reconstruction: NDArray[Any]
) -> bytes:
    """A PNG with the originals above their reconstructions; both (M, C, H, W) in 0 to 255."""
    above, below = (
        _side_by_side(_enlarged(settings, frames)[:, None])[0]
        for frames in (original, reconstruction)
    )
    gap = np.full((GAP, *above.shape[1:]), 255, np.uint8)
    file = io.BytesIO()
    Image.fromarray(np.concatenate([above, gap, below])).save(file, format="PNG")
    return file.getvalue()


def _enlarged(settings: TaskSettings, frames: NDArray[Any]) -> Pictures:
    """Frames (..., C, H, W) as their simulator draws them for people, (..., rows, columns, 3)."""
    return picture(settings, frames, factor=max(1, -(-SIDE // frames.shape[-2])))


def _side_by_side(pictures: Pictures) -> Pictures:
    """(K, T, rows, columns, 3) to (T, rows, K columns and gaps, 3)."""
    gap = np.full((*pictures.shape[1:3], GAP, 3), 255, np.uint8)
    parts = [pictures[0]]
    for shown in pictures[1:]:
        parts += [gap, shown]
    return np.concatenate(parts, axis=2)
