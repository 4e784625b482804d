"""Every method, killed at each kind of moment that it has."""

from collections.abc import Callable

import pytest
from disturbed import Matrix

from solar_cli.settings.registry import BUILT_IN

COLLECTING = (
    "collecting:7:both",  # in iteration 1, ...
    "collected:1:worker",
    "evaluating:4:worker",  # ... its policy, ...
    "renamed:1:scheduler",
    "collecting:3:both",  # ... and the iterations after it
    "updated:1:both",
    "committed:1:worker",
)
TRAINING = ("training:1:worker", *COLLECTING, "training:2:both", "training:1:scheduler")
ON_POLICY = (
    "collecting:5:worker",  # the only rollout of iteration 1, of which no file is kept, ...
    "collected:1:both",
    "training:2:worker",  # ... the two of iteration 2, ...
    "evaluating:3:both",
    "collecting:25:worker",  # ... and the seven of iteration 3
    "training:3:both",
    "renamed:2:worker",
    "updated:1:both",
)
KILLS = {
    "ppo": ON_POLICY,
    "trpo": ON_POLICY,
    # They train nothing.
    "lqr-flm": COLLECTING,
    "random": COLLECTING,
    "zero": COLLECTING,
}


@pytest.mark.parametrize("method", [entry.name for entry in BUILT_IN])
def test_kills_change_no_bit_of_any_method(matrix: Callable[..., Matrix], method: str) -> None:
    task = "car-states" if method == "mpc-nn" else "nav"
    quiet, run = (matrix(1, task, method) for _ in range(2))
    assert all(result["finished"] for result in quiet.finish())
    for where in KILLS.get(method, TRAINING):
        run.die(where)
    assert all(result["finished"] for result in run.finish())
    assert run.fingerprints() == quiet.fingerprints()
