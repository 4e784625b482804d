"""A method and a task that do not go together: one line, exit code 2, before anything runs."""

from pathlib import Path

import pytest
from scenario import Solar

PAIRS = {
    "images": ("nav", ["'mpc-nn'", "state", "'nav' gives image", "choose solar", "global-mpc"]),
    "a reward that is known of steps only": (
        "pusher",
        ["pusher/mpc-nn", "task.parameters.cost", "squares", "choose global-mpc"],
    ),
}


@pytest.mark.parametrize("pair", PAIRS)
def test_mpc_nn_needs_states_and_their_cost(solar: Solar, tmp_path: Path, pair: str) -> None:
    task, parts = PAIRS[pair]
    db = tmp_path / "new.db"
    solar("run", "--task", task, "--method", "mpc-nn", "--db", db).refused(*parts)
    assert not list(tmp_path.glob("new.db.files/cells/*"))


def test_more_elites_than_samples_are_refused(solar: Solar, tmp_path: Path) -> None:
    sets = ("--set", "methods.global-mpc.planner.samples=5")
    run = ("run", "--task", "nav", "--method", "global-mpc", "--db", tmp_path / "new.db")
    solar(*run, *sets).refused("elites: more than samples")
