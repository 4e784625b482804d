"""Every task, killed where its simulator has a state of its own to lose."""

from collections.abc import Callable
from pathlib import Path

import pytest
from disturbed import Matrix

from solar_cli.settings import card_names

KILLS = ("collecting:5:worker", "training:2:both", "evaluating:3:worker", "collecting:4:both")

MUJOCO = """extends = "sawyer"
[task.parameters]
backend = "mujoco"
"""


@pytest.fixture(params=sorted({*card_names(), "sawyer-mujoco"} - {"nav", "nav-fixed"}))
def task(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param != "sawyer-mujoco":
        return str(request.param)
    card = tmp_path / "sawyer-mujoco.toml"
    card.write_text(MUJOCO)
    return str(card)


def test_kills_change_no_bit_of_any_task(matrix: Callable[..., Matrix], task: str) -> None:
    quiet, run = matrix(1, task), matrix(1, task)
    assert all(result["finished"] for result in quiet.finish())
    for where in KILLS:
        run.die(where)
    assert all(result["finished"] for result in run.finish())
    assert run.fingerprints() == quiet.fingerprints()
