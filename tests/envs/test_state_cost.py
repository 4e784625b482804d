"""The cost that a method may know is the cost that episodes have."""

import numpy as np
import pytest
import torch

from solar_cli.control.exploration import Exploration
from solar_cli.envs import build_task, state_cost
from solar_cli.episodes import Episodes, roll_out
from solar_cli.errors import UsageError
from solar_cli.settings import TaskSettings, load_card
from solar_cli.streams import Streams


def pendulum() -> TaskSettings:
    """The inverted pendulum, its state seen, with a known weight of actions."""
    card = load_card("inverted-pendulum").task.model_dump()
    card["observation"] = {"kind": "state", "width": 4, "window": 1}
    card["parameters"] = {
        "id": "InvertedPendulum-v5",
        "names": ["cart", "angle", "cart_speed", "angle_speed"],
        "cost": {"angle": {"weight": 10.0}, "cart": {"weight": 1.0, "target": 0.5}},
    }
    return TaskSettings.model_validate({**card, "action_cost": 0.3, "horizon": 12})


TASKS = {"car-states": load_card("car-states").task, "a Gymnasium card's squares": pendulum()}


def noisy(task: TaskSettings) -> Episodes:
    streams = Streams(0)
    resets = [streams.generator("reset", i) for i in range(3)]
    found = roll_out(build_task(task), task, Exploration(task), resets, streams.generator("noise"))
    return found.episodes


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("tensors", [False, True])
def test_the_known_cost_is_the_one_that_steps_have(name, tensors):
    task = TASKS[name]
    episodes = noisy(task)
    states, actions = episodes.frames[:, :-1].astype(np.float64), episodes.actions
    if tensors:
        states, actions = torch.from_numpy(states), torch.from_numpy(actions)
    found = np.asarray(state_cost(task)(states, actions))
    live = episodes.live_steps
    assert float(np.ptp(episodes.costs[live])) > 0.01
    np.testing.assert_allclose(found[live], episodes.costs[live], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("card", "says"), [("car", "images"), ("reacher", "images"), ("pusher", "a reward is known of")]
)
def test_a_task_whose_states_have_no_known_cost_says_so(card, says):
    with pytest.raises(UsageError, match=says):
        state_cost(load_card(card).task)


def test_a_simulator_without_a_cost_of_states_says_so():
    seen = {"kind": "state", "width": 4}
    task = load_card("nav").task.model_dump() | {"observation": seen}
    with pytest.raises(UsageError, match="'navigation' says no cost"):
        state_cost(TaskSettings.model_validate(task))
