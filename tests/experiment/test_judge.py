"""What a judge shows of an evaluation: the very episodes that it judged, drawn for people."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from solar_cli.envs import drawable, picture
from solar_cli.experiment import judge
from solar_cli.experiment.judge import Judge
from solar_cli.settings import cells, load_card

SHORT = ("task.horizon=12", "evaluation.episodes=5")


class Swinging:
    """Acts by the clock, and by what it sees in its episode."""

    def __init__(self, size=2):
        self.size = size

    def start(self, episodes, stream):
        return None

    def act(self, observations, t, state):
        seen = observations[:, -1].reshape(len(observations), -1).astype(np.float64)
        actions = 4 * np.cos(0.7 * t * np.arange(1, self.size + 1) + seen[:, : self.size])
        return actions, actions, state


class Unseen(gymnasium.Env):
    """Has the spaces of the pusher, and nothing to look at."""

    metadata = {"render_modes": []}  # noqa: RUF012
    observation_space = spaces.Box(-np.inf, np.inf, (23,))
    action_space = spaces.Box(-2.0, 2.0, (7,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(23), {}

    def step(self, action):
        return np.zeros(23), 0.0, False, False, {}


gymnasium.register("Test/Unseen-v0", Unseen)


def judged(card, policy, *sets, iteration=3):
    """The judge of a cell, and what it judged after an iteration."""
    [cell] = cells(load_card(card), "solar", [0], "smoke", [*SHORT, *sets])
    found = Judge(cell)
    return found, found.evaluate(policy, iteration), cell.configuration.task


def test_of_a_state_task_the_very_episodes_are_drawn(monkeypatch):
    """An oracle draws the recorded states, twice as large as on 64x64 pixels."""
    monkeypatch.setattr(judge, "DRAWN_ROWS", 128)
    of, evaluation, settings = judged("car-states", Swinging())
    frames = of.pictures(evaluation, 3, 2)
    assert frames.dtype == np.uint8
    assert frames.shape == (2, 13, 1, 128, 128)
    expected = picture(settings, evaluation.episodes.frames[:2], 2).astype(int)
    shown = picture(drawable(settings, 128), frames, 1).astype(int)
    assert np.abs(shown - expected).max() <= 2  # states are in float32, pictures in 8 bits
    # Episodes differ, and so does each from its start: any other one would be seen.
    assert np.abs(expected[0] - expected[1]).max() > 100
    assert (np.abs(expected[:, -1] - expected[:, 0]).max(axis=(1, 2, 3)) > 100).all()


def test_of_an_image_task_frames_are_what_was_seen():
    of, evaluation, _ = judged("nav", Swinging())
    np.testing.assert_array_equal(of.pictures(evaluation, 3, 2), evaluation.episodes.frames[:2])


@pytest.mark.filterwarnings("ignore:.*render_mode")
def test_a_task_that_nothing_draws_has_no_pictures():
    of, evaluation, _ = judged("pusher", Swinging(7), 'task.parameters.id="Test/Unseen-v0"')
    assert evaluation.episodes.frames.shape == (5, 13, 23)
    assert of.pictures(evaluation, 3, 2) is None
