"""Every method, killed at each kind of moment that it has."""

from collections.abc import Callable

import pytest
from disturbed import Matrix

from solar_cli.settings.registry import BUILT_IN

REFERENCE = (  # the one iteration that a policy has which learns nothing
    "collecting:7:both",
    "collected:1:worker",
    "renamed:1:both",
    "updated:1:scheduler",
    "evaluating:4:both",
)
FITTED = (*REFERENCE, "collecting:3:scheduler", "committed:1:worker")
TRAINED = (
    "collecting:7:both",  # in iteration 1, ...
    "training:1:worker",
    "renamed:1:both",
    "evaluating:4:both",
    "collected:1:worker",  # ... 2, ...
    "training:1:both",
    "updated:1:both",  # ... and 3
    "evaluating:4:scheduler",
)
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
    "lqr-flm": FITTED,
    "ppo": ON_POLICY,
    "random": REFERENCE,
    "trpo": ON_POLICY,
    "zero": REFERENCE,
}


@pytest.mark.parametrize("method", [entry.name for entry in BUILT_IN])
def test_kills_change_no_bit_of_any_method(matrix: Callable[..., Matrix], method: str) -> None:
    task = "car-states" if method == "mpc-nn" else "nav"
    quiet, run = (matrix(1, task, method) for _ in range(2))
    assert all(result["finished"] for result in quiet.finish())
    for where in KILLS.get(method, TRAINED):
        run.die(where)
    assert all(result["finished"] for result in run.finish())
    assert run.fingerprints() == quiet.fingerprints()
