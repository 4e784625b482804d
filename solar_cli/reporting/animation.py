"""Pictures for people: a task in motion, a cell's policy at work, what its model sees."""

from __future__ import annotations

import hashlib
import io
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from solar_cli.envs import picture
from solar_cli.errors import SolarError
from solar_cli.settings import TaskSettings
from solar_cli.store.records import ArtifactRecord
from solar_cli.wording import counted

Pictures = NDArray[np.uint8]

SIDE = 160
"""Least height of one frame on the screen, in pixels."""
PREVIEW_SIDE = 240
"""The same, where there is one episode only."""
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


class Preview(NamedTuple):
    """A task in motion, before anything is learned."""

    gif: bytes
    caption: str
    """what is seen where"""


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
    return _gif(_side_by_side(_enlarged(settings, frames[:EPISODES])))


def preview(settings: TaskSettings, drawn: TaskSettings, frames: NDArray[Any]) -> Preview:
    """One episode of a task: what a learner sees, pixel by pixel, and beside it what people do.

    ``drawn`` is the same task as `drawable` has it, and ``frames`` (T+1, C, H, W) uint8 are its.
    """
    seen, people = settings.observation, _enlarged(drawn, frames, PREVIEW_SIDE)[None]
    if seen.kind == "state":
        caption = f"for people: a learner sees {counted(seen.width, 'number')}"
        return Preview(_gif(_side_by_side(people)), caption)
    panels = _as_seen(frames)
    factor = people.shape[2] // panels.shape[2]
    learner = panels.repeat(factor, axis=2).repeat(factor, axis=3)
    what = f"the {len(panels)} channels that" if len(panels) > 1 else "what"
    caption = f"{what} a learner sees"
    if seen.window > 1:
        caption += f", {seen.window} frames at a time"
    if np.array_equal(panels, picture(drawn, frames, factor=1)[None]):  # smoother, no more
        return Preview(_gif(_side_by_side(learner)), caption)
    both = _side_by_side(np.concatenate([learner, people]))
    return Preview(_gif(both), f"left: {caption}; right: for people")


def _gif(shown: Pictures) -> bytes:
    """An endless GIF of pictures (T, rows, columns, 3)."""
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
    """A PNG with the originals above what a model made of them; both (M, C, H, W) in 0 to 255."""
    above, below = (
        _side_by_side(_enlarged(settings, frames)[:, None])[0]
        for frames in (original, reconstruction)
    )
    gap = np.full((GAP, *above.shape[1:]), 255, np.uint8)
    file = io.BytesIO()
    Image.fromarray(np.concatenate([above, gap, below])).save(file, format="PNG")
    return file.getvalue()


def _enlarged(settings: TaskSettings, frames: NDArray[Any], side: int = SIDE) -> Pictures:
    """Frames (..., C, H, W) as their simulator draws them for people, (..., rows, columns, 3)."""
    return picture(settings, frames, factor=max(1, -(-side // frames.shape[-2])))


def _as_seen(frames: NDArray[Any]) -> Pictures:
    """Frames (T, C, H, W) in colour, (1, T, H, W, 3), or each channel in grey, (C, T, H, W, 3)."""
    if frames.shape[1] == 3:
        return np.moveaxis(frames, 1, -1)[None]
    return np.repeat(np.moveaxis(frames, 1, 0)[..., None], 3, axis=-1)


def _side_by_side(pictures: Pictures) -> Pictures:
    """(K, T, rows, columns, 3) to (T, rows, K columns and gaps, 3)."""
    gap = np.full((*pictures.shape[1:3], GAP, 3), 255, np.uint8)
    parts = [pictures[0]]
    for shown in pictures[1:]:
        parts += [gap, shown]
    return np.concatenate(parts, axis=2)
