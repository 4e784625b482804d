"""Makes the database of today's schema that later versions must still open.

Run once for each schema, when it is released: ``python tests/store/assets/make.py``. An old one is
never made again: a setting that comes later declares what older runs had in effect (``added``).
"""

import json
import shutil
from pathlib import Path

import numpy as np

from solar_cli.settings import cells, load_card
from solar_cli.store.owner import Owner
from solar_cli.store.records import CheckpointRecord, Metric, Outcome
from solar_cli.store.schema import HEAD
from solar_cli.store.store import Store

FOLDER = Path(__file__).parent


def main() -> None:
    """Write ``HEAD.db`` with one finished cell, and ``HEAD.json`` with what it holds."""
    path = FOLDER / f"{HEAD}.db"
    path.unlink(missing_ok=True)
    (cell,) = cells(load_card("nav"), "solar", [7], "smoke")
    with Store.open(str(path)) as store:
        store.add([cell])
        owner = Owner("host", 4321, 98.5, "boot")
        attempt = store.claim(cell.hash, owner, 40, {"commit": "c0ffee", "dirty": False})
        store.commit(
            cell.hash,
            attempt,
            iteration=1,
            episodes=40,
            steps=1600,
            simulated_seconds=80.0,
            seconds=2.5,
            metrics=[
                Metric("final_distance", 0.375, "noise_free", np.array([0.25, 0.5])),
                Metric("loss", float("nan"), "model"),
                Metric("return", -12.0),
            ],
            checkpoint=CheckpointRecord("checkpoints/1.0-1.pt", "0" * 64, 9, 1, 40, 0, True),
        )
        file = store.folder(cell.hash) / "animation.npz"
        file.parent.mkdir(parents=True)
        file.write_bytes(b"")
        store.add_artifact(cell.hash, attempt, "animation", file, 1)
        store.end(cell.hash, attempt, Outcome.FINISHED)
        shutil.rmtree(store.home)
    expected = {
        "hash": cell.hash,
        "metrics": [
            [1, "model", "loss", "nan", 40],
            [1, "noise_free", "final_distance", "finite", 40],
            [1, "train", "return", "finite", 40],
        ],
    }
    (FOLDER / f"{HEAD}.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
