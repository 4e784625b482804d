"""``solar diagnose``: what it prints, what it refuses, and that it stores nothing."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest
from scenario import Solar, Stored

from solar_cli.settings import Cell

SMALL = (
    *("--task", "nav", "--variant", "smoke", "--episodes", "8"),
    *("--set", "task.horizon=4", "--set", "methods.solar.training.steps=4"),
    *("--set", 'methods.solar.cost_fit.per_time="never"', "--set", "evaluation.episodes=2"),
)
ROWS = ["as it is", "true state", "simulator's dynamics", "true cost", "all of these"]


@pytest.fixture(autouse=True)
def own_environment() -> object:
    """The command prepares its process, which is that of the tests here."""
    with mock.patch.dict(os.environ):
        yield


def test_a_diagnosis_computes_every_row_and_leaves_the_store_alone(
    stored: Stored, tmp_path: Path
) -> None:
    before, files = stored.db.read_bytes(), sorted(stored.db.parent.rglob("*"))
    folder = tmp_path / "empty"
    folder.mkdir()
    program = "import sys; from solar_cli.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", program, "diagnose", *SMALL, "--json", "--db", str(stored.db)],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
    )
    assert done.returncode == 0, done
    plain = json.loads(done.stdout)
    assert (plain["task"], plain["method"], plain["seed"]) == ("nav", "solar", 0)
    assert [finding["replaced"] for finding in plain["findings"]] == ROWS
    assert {finding["episodes"] for finding in plain["findings"]} == {8}
    # Where it stands is said at once, on the other channel.
    assert [line.split(":")[0] for line in done.stderr.splitlines()] == ROWS
    assert (stored.db.read_bytes(), sorted(stored.db.parent.rglob("*"))) == (before, files)
    assert list(folder.iterdir()) == []


def test_the_table_has_level_and_gain_of_each_row(
    solar: Solar, monkeypatch: pytest.MonkeyPatch
) -> None:
    from solar_cli.experiment import diagnosis, worker

    rows = [
        diagnosis.Finding("as it is", 0.5, 0.0, 240, 40.0),
        diagnosis.Finding("true state", 0.125, 0.375, 240, 5.0),
        diagnosis.Finding("true cost", math.nan, math.nan, 80, 5.0, ("diverged [red]",)),
    ]
    asked = []

    def diagnose(cell: Cell, episodes: int, device: str) -> list[diagnosis.Finding]:
        asked.append((cell.title, episodes, device))
        return rows

    monkeypatch.setattr(worker, "prepare_torch", lambda device: "cpu")
    monkeypatch.setattr(diagnosis, "diagnose", diagnose)
    done = solar("diagnose", "--task", "nav", "--method", "vae", "--seed", "3")
    assert (done.code, asked) == (0, [("nav/vae seed 3", 240, "cpu")])
    assert "final_distance in world units after 240 episodes (lower is better)" in done.out
    table = [line.split() for line in done.out.splitlines()]
    assert ["as", "it", "is", "0.5"] in table
    assert ["true", "state", "0.125", "0.375"] in table
    assert ["true", "cost", "nan", "nan", "diverged", "[red]"] in table


FAULTS = {
    "unknown task": (("--task", "nva"), ["'nva'", "did you mean 'nav'"]),
    "unknown method": (("--method", "sloar"), ["'sloar'", "did you mean 'solar'"]),
    "unknown variant": (("--variant", "smok"), ["'smok'", "did you mean 'smoke'"]),
    "unknown setting": (("--set", "task.horzon=3"), ["task.horzon", "did you mean 'horizon'"]),
    "setting of another method": (("--set", "methods.vae.training.steps=3"), ["no method 'vae'"]),
    "no episodes": (("--episodes", "0"), ["--episodes", "1"]),
    "no such seed": (("--seed", "-1"), ["--seed", "0"]),
    "unknown measure": (
        ("--set", 'evaluation.headline="final_distanc"'),
        ["headline", "did you mean 'final_distance'"],
    ),
    "layers that do not fit": (
        (
            "--set",
            'methods.solar.representation.encoder=[{kind="unshuffle", factor=7}]',
        ),
        ["nav/solar", "7"],
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_diagnosis_refuses_bad_input(solar: Solar, fault: str) -> None:
    extra, told = FAULTS[fault]
    solar("diagnose", "--task", "nav", *extra).refused(*told)


def test_a_diagnosis_needs_a_task(solar: Solar) -> None:
    solar("diagnose").refused("--task")
