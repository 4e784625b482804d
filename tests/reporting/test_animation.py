"""Pictures: every frame is there, large enough to see, and a damaged file is said to be one."""

import io

import numpy as np
import pytest
from hand_made import CARD, add_pictures, cell, compute, database
from PIL import Image

from solar_cli.envs import build_task, drawable
from solar_cli.errors import SolarError
from solar_cli.reporting.animation import (
    GAP,
    SIDE,
    animation,
    arrays,
    preview,
    reconstructions,
)
from solar_cli.reporting.curves import problems
from solar_cli.reporting.sections import exhibit
from solar_cli.settings import cells, load_card
from solar_cli.store.records import Outcome

MOVE = np.array([[5.0, 0.0]])


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


def panels(shown):
    """Every picture of a preview as its panels, white gaps left out, (T, panels, side, side, 3)."""
    gif = Image.open(io.BytesIO(shown.gif))
    pictures = []
    for frame in range(gif.n_frames):
        gif.seek(frame)
        pictures.append(np.asarray(gif.convert("RGB")).astype(int))
    side = pictures[0].shape[0]
    starts = range(0, pictures[0].shape[1], side + GAP)
    return np.array([[whole[:, start : start + side] for start in starts] for whole in pictures])


def test_a_preview_shows_each_channel_as_it_is_and_then_a_picture():
    frames = moving(1, 5)[0]
    frames[:, 1, 20, 20] = 255
    shown = preview(CARD.task, CARD.task, frames)
    assert shown.caption == "left: the 2 channels that a learner sees; right: for people"
    found = panels(shown)
    assert found.shape == (5, 3, 256, 256, 3)
    pixels = frames.repeat(8, axis=2).repeat(8, axis=3)[..., None]
    np.testing.assert_allclose(found[:, :2], np.broadcast_to(pixels, found[:, :2].shape), atol=12)
    people = found[:, 2].sum(axis=-1)
    assert (people[:, 60:196, 60:196].max(axis=(1, 2)) > 700).all()  # paper
    assert (people.min(axis=(1, 2)) < 250).all()  # and a dark agent


def test_a_preview_shows_once_what_is_the_same_for_people_and_learners():
    settings = load_card("sawyer").task
    frames = np.zeros((3, 3, 84, 84), np.uint8)
    frames[:, 0, 10:20, 30:] = 200
    for step in range(3):  # pictures that are alike would be one, shown for longer
        frames[step, 2, :40] = 60 * step
    shown = preview(settings, settings, frames)
    assert shown.caption == "what a learner sees"
    found = panels(shown)
    expected = np.moveaxis(frames, 1, -1).repeat(3, axis=1).repeat(3, axis=2)
    np.testing.assert_allclose(found[:, 0], expected, atol=3)
    windowed = load_card("car").task
    caption = preview(windowed, windowed, frames[:, :1, :64, :64]).caption
    assert caption == "left: what a learner sees, 4 frames at a time; right: for people"


def test_a_preview_of_a_state_is_a_picture_for_people():
    settings = load_card("car-states").task
    drawn = drawable(settings, 240)
    task = build_task(drawn)
    frames = np.concatenate([task.reset([np.random.default_rng(0)])] + 3 * [task.step(MOVE)[0]])
    shown = preview(settings, drawn, frames)
    assert shown.caption == "for people: a learner sees 9 numbers"
    found = panels(shown)
    assert found.shape[1:] == (1, 240, 240, 3)
    assert np.abs(found[0, 0, :120, 120:].astype(int) - 255).max() < 6  # nothing is up there
    assert found[0, 0, 120:, 120:].min() < 60  # the car starts in the bottom right


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
    assert shown.prediction
    assert shown.latents
    assert shown.damage == ()


@pytest.mark.parametrize("stored", ["pictures", "states"])
def test_of_a_state_task_the_policy_is_shown_and_nothing_of_its_model(tmp_path, stored):
    """Older versions stored the states where newer ones store pictures: then there is nothing."""
    [of] = cells(load_card("car-states"), "solar", [0])
    settings, rng = of.configuration.task, np.random.default_rng(0)
    if stored == "pictures":
        frames = rng.integers(0, 255, (3, 4, 1, 40, 40), dtype=np.uint8)
    else:
        frames = rng.normal(size=(3, 4, 9)).astype(np.float32)
    with database(tmp_path) as store:
        add_pictures(store, of, compute(store, of, [1.0, 0.5], None), frames)
        (problem,) = problems(store)
        shown = exhibit(problem.curves[0], {(a.cell, a.kind): a for a in store.artifacts()})
    if stored == "states":
        assert shown is None
        return
    assert shown.animation == animation(drawable(settings, 40), frames)
    assert (shown.reconstruction, shown.prediction, shown.latents) == (None, None, None)
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
