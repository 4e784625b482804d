"""PPO and TRPO, killed within an iteration of many rollouts, of which no file is kept."""

from collections.abc import Callable

import pytest
from disturbed import Matrix

KILLS = (
    "collecting:5:worker",  # the only rollout of iteration 1, ...
    "collected:1:both",
    "training:2:worker",  # ... the two of iteration 2, ...
    "evaluating:3:both",
    "collecting:25:worker",  # ... and the seven of iteration 3
    "training:3:both",
    "renamed:2:worker",
    "updated:1:both",
)


@pytest.mark.parametrize("method", ["ppo", "trpo"])
def test_kills_change_no_bit(matrix: Callable[..., Matrix], method: str) -> None:
    quiet, run = matrix(1, method=method), matrix(1, method=method)
    assert all(result["finished"] for result in quiet.finish())
    for where in KILLS:
        run.die(where)
    assert all(result["finished"] for result in run.finish())
    assert run.fingerprints() == quiet.fingerprints()
