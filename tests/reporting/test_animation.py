"""Pictures: every frame is there, large enough to see, and a damaged file is said to be one."""

import io

import numpy as np
import pytest
from hand_made import CARD, add_pictures, cell, compute, database
from PIL import Image

from solar_cli.errors import SolarError
from solar_cli.reporting.animation import GAP, SIDE, animation, arrays, reconstructions
from solar_cli.reporting.curves import problems
from solar_cli.reporting.sections import exhibit
from solar_cli.store.records import Outcome


def moving(episodes, steps):
    """An agent that crosses the image, one pixel a step; another row for each episode."""
    frames = np.zeros((episodes, steps, 2, 32, 32), np.uint8)
    for episode in range(episodes):
        for step in range(steps):
            frames[episode, step, 0, 8 + 4 * episode, 8 + step] = 255
    return frames


def test_an_animation_has_a_picture_a_step_and_the_episodes_side_by_side():
    gif = Image.open(io.BytesIO(animation(CARD.task, moving(3, 6))))
    assert gif.format == "GIF"
    assert gif.n_frames == 6
    assert gif.size == (3 * SIDE + 2 * GAP, SIDE)
    assert gif.info["loop"] == 0


def test_the_last_picture_stays_longest():
    gif = Image.open(io.BytesIO(animation(CARD.task, moving(1, 4))))
    durations = []
    for frame in range(gif.n_frames):
        gif.seek(frame)
        durations.append(gif.info["duration"])
    assert durations[-1] > 5 * max(durations[:-1])


def test_the_agent_moves_to_the_right_in_the_animation():
    gif = Image.open(io.BytesIO(animation(CARD.task, moving(1, 6))))
    columns = []
    for frame in (0, 5):
        gif.seek(frame)
        dark = 255 - np.asarray(gif.convert("L"), dtype=float)
        # Off the grey that lies behind the walls, and off paper that is not quite white.
        inside = np.maximum(dark[20:140, 20:140] - 50, 0)
        columns.append((inside.sum(axis=0) * np.arange(120)).sum() / inside.sum())
    assert columns[1] - columns[0] == pytest.approx(5 * SIDE / 32, abs=SIDE / 32)


def test_originals_stand_above_their_reconstructions():
    frames = moving(1, 4)[0]
    blank = np.zeros_like(frames, dtype=np.float32)
    picture = np.asarray(Image.open(io.BytesIO(reconstructions(CARD.task, frames, blank))))
    assert picture.shape == (2 * SIDE + GAP, 4 * SIDE + 3 * GAP, 3)
    above, below = picture[:SIDE], picture[SIDE + GAP :]
    assert above.min() < 100 < below.min()  # only the upper row shows the dark agent


def test_the_seed_that_is_shown_is_the_one_in_the_middle(tmp_path):
    with database(tmp_path) as store:
        for seed, final in enumerate([0.3, 0.1, 0.2]):
            of = cell(seed=seed)
            attempt = compute(store, of, [1.0, final], None)
            add_pictures(store, of, attempt)
            store.end(of.hash, attempt, Outcome.FINISHED)
        artifacts = {(a.cell, a.kind): a for a in store.artifacts()}
        (problem,) = problems(store)
        shown = exhibit(problem.curves[0], artifacts)
    assert shown.seed == 2
    assert shown.animation
    assert shown.reconstruction
    assert shown.damage == ()


def test_a_damaged_or_missing_file_is_said_and_the_rest_is_shown(tmp_path):
    of = cell()
    with database(tmp_path) as store:
        attempt = compute(store, of, [1.0, 0.5], None)
        add_pictures(store, of, attempt)
        artifacts = {(a.cell, a.kind): a for a in store.artifacts()}
        path = artifacts[of.hash, "animation"].path
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
        (problem,) = problems(store)
        shown = exhibit(problem.curves[0], artifacts)
        assert shown.animation is None
        assert shown.reconstruction
        assert "SHA-256" in shown.damage[0]
        path.unlink()
        with pytest.raises(SolarError, match="No such file") as missing:
            arrays(artifacts[of.hash, "animation"])
        # The cell is finished: its numbers must not be discarded for the sake of a picture.
        for said in (shown.damage[0], str(missing.value)):
            assert f"animation.npz of cell {of.hash[:8]}" in said
            assert "--redo" not in said
            assert str(tmp_path) not in said
