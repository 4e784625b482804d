"""A watched task is the task, and says how far the expected episodes are."""

import numpy as np
import pytest

from solar_cli.envs import build_task
from solar_cli.episodes import evaluate
from solar_cli.experiment.watched import WatchedTask
from solar_cli.settings import cells, load_card
from solar_cli.streams import Streams

SETTINGS = cells(load_card("nav"), "solar", [0], "smoke")[0].configuration.task


class Still:
    def start(self, episodes, stream): ...

    def act(self, observations, t, state):
        zeros = np.zeros((len(observations), SETTINGS.action.size))
        return zeros, zeros, state


@pytest.mark.parametrize("at_once", [None, 2])
def test_shares_rise_step_by_step_over_all_groups_of_episodes(at_once):
    task, shares = build_task(SETTINGS), []
    task.at_once = at_once
    watched = WatchedTask(task, shares.append)
    for episodes in (5, 3):
        shares.clear()
        watched.expect(episodes)
        evaluate(watched, SETTINGS, Still(), episodes, Streams(1))
        groups = 1 if at_once is None else -(-episodes // at_once)
        assert len(shares) == groups * (SETTINGS.horizon + 1)
        assert shares[0] == 0.0
        assert shares == sorted(shares)
        assert [share for share in shares if share >= 1.0] == [1.0]
        largest = (at_once or episodes) / episodes / SETTINGS.horizon  # one step of a whole group
        assert max(np.diff(shares)) == pytest.approx(largest)


def test_watching_changes_no_bit_of_an_episode():
    plain, watched = build_task(SETTINGS), WatchedTask(build_task(SETTINGS), lambda share: None)
    watched.expect(4)
    one, two = (evaluate(task, SETTINGS, Still(), 4, Streams(1)) for task in (plain, watched))
    for name in ("frames", "actions", "costs", "lengths"):
        np.testing.assert_array_equal(getattr(one.episodes, name), getattr(two.episodes, name))
    np.testing.assert_array_equal(one.truth, two.truth)
    assert one.measures.keys() == two.measures.keys()
