"""How every method begins, without torch."""

import subprocess
import sys

import numpy as np
import pytest

from solar_cli.control.exploration import Exploration
from solar_cli.methods.solar import Solar
from solar_cli.settings import load_card, resolve
from solar_cli.streams import Streams


@pytest.mark.parametrize("card", ["nav", "reacher"])
def test_exploration_is_what_a_local_method_does_first(card):
    sets = ["task.horizon=9", "task.exploration.smoothing=1.5"]
    configuration = resolve(load_card(card), "solar", "smoke", sets).configuration
    task = configuration.task
    method = Solar(configuration.method, task, Streams(0), "cpu", lambda *_: None).policy
    window = np.zeros((3, task.observation.window, *task.observation.frame_shape), np.uint8)
    for stream in (lambda: np.random.default_rng(1), lambda: None):
        noise = Exploration(task)
        states = [policy.start(3, stream()) for policy in (noise, method)]
        for t in range(task.horizon):
            action, mean, states[0] = noise.act(window, t, states[0])
            expected, expected_mean, states[1] = method.act(window, t, states[1])
            np.testing.assert_allclose(action, expected, rtol=1e-12)
            np.testing.assert_array_equal(mean, expected_mean)


def test_exploration_imports_no_torch():
    code = "import sys, solar_cli.control.exploration; print('torch' in sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "False"
