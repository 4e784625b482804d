"""The numbers in ``reports/paper`` are what this code computes: one cell's first iteration, again.

Run by ``.ci/run``; it takes as long as a training does, so that ``make test`` leaves it out.
"""

import csv
from pathlib import Path

import pytest

import solar_cli
from solar_cli.cli import main

COMMITTED = Path(__file__).parents[2] / "reports" / "paper" / "nav" / "evaluations.csv"
SEED = 100


def test_the_first_iteration_of_a_committed_cell_can_be_computed_again(tmp_path: Path) -> None:
    with COMMITTED.open(newline="") as file:
        committed = {
            int(row["episodes"]): (row["cell"], float(row["final_distance"]))
            for row in csv.DictReader(file)
            if (row["method"], row["variant"], row["seed"]) == ("solar", "default", str(SEED))
        }
    database = tmp_path / "solar.db"
    first = sorted(committed)[1]
    arguments = ["run", "--task", "nav", "--method", "solar", "--seeds", f"{SEED}:{SEED + 1}"]
    assert main([*arguments, "--budget", str(first), "--db", str(database)]) == 0

    rows = solar_cli.load(str(database)).query("name == 'final_distance' and split == 'noise_free'")
    again = {row.episodes: (row.cell, row.value) for row in rows.itertuples()}
    assert set(again) == {0, first}
    assert again[0][0] == committed[0][0], "another configuration has the committed name"
    # Nothing is learned before the first evaluation: another processor may round, no more.
    assert again[0][1] == pytest.approx(committed[0][1], rel=1e-6)
    # Training amplifies rounding, not beyond what separates one training from another.
    assert again[first][1] == pytest.approx(committed[first][1], abs=0.05)
