"""Records, curves and a database made by hand, with round numbers that a reader can add up."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stored_cells import store_attempt

from solar_cli.reporting.curves import Curve, Problem, SeedCurve, seed_curve
from solar_cli.settings import Cell, EvaluationSettings, cells, load_card
from solar_cli.store.records import AttemptRecord, CellRecord, Metric, Outcome, Owner, State
from solar_cli.store.store import Store

CARD = load_card("nav")
LOWER = EvaluationSettings(
    headline="final_distance", better="lower", unit="units", levels=(0.5, 0.1), episodes=4
)
HIGHER = EvaluationSettings(headline="return", better="higher")
CODE = {"commit": "a" * 40, "dirty": False, "diff_sha256": None, "version": "0.1.0"}
OTHER_CODE = {**CODE, "commit": "b" * 40}
DIRTY_CODE = {**CODE, "dirty": True, "diff_sha256": "c" * 64}
NOW = datetime(2026, 1, 1, tzinfo=UTC)

Points = Sequence[tuple[int, float]]


def cell(method: str = "solar", seed: int = 0, variant: str = "default", *sets: str) -> Cell:
    """A cell of ``nav``; with ``sets``, ``variant`` is what to call it."""
    if sets:
        return cells(CARD, method, [seed], "default", sets, variant)[0]
    return cells(CARD, method, [seed], variant)[0]


def record(
    of: Cell,
    state: State = State.FINISHED,
    provenance: dict[str, Any] = CODE,
    error: str | None = None,
    number: int = 1,
) -> CellRecord:
    attempt = AttemptRecord(
        number, Owner("host", 1, 0.0, ""), NOW, NOW, NOW, None, error, 100, "", 1.0, provenance
    )
    return CellRecord(of, state, 1, 100, 5000, 60.0, 100, attempt, provenance["commit"], False, NOW)


def seed(
    number: int,
    points: Points,
    state: State = State.FINISHED,
    measure: EvaluationSettings = LOWER,
    **kept: Any,
) -> SeedCurve:
    made = seed_curve(record(cell(seed=number), state, **kept), points, measure)
    assert made is not None
    return made


def curve(*seeds: SeedCurve, label: str = "solar", extra: Sequence[CellRecord] = ()) -> Curve:
    records = (*(one.record for one in seeds), *extra)
    measure = LOWER if seeds[0].better == "lower" else HIGHER
    return Curve(label, label.split(":")[0], "default", "0" * 16, measure, records, seeds)


def flat_curve(label: str, finals: Sequence[float], episodes: int = 100) -> Curve:
    """A curve whose seeds start at 1 and end at ``finals``."""
    return curve(
        *(seed(i, [(0, 1.0), (episodes, final)]) for i, final in enumerate(finals)), label=label
    )


def problem(*curves: Curve) -> Problem:
    return Problem("nav", "nav", curves[0].measure, curves, ())


def compute(
    store: Store,
    of: Cell,
    distances: Sequence[float],
    outcome: Outcome | None = Outcome.FINISHED,
    provenance: dict[str, Any] = CODE,
    error: str | None = None,
    train: dict[str, Sequence[float]] | None = None,
) -> int:
    """Store what a worker would: the headline measure at 0, 10, 20, ... episodes.

    ``train`` has further measures, a value for each iteration from 1 on. Returns the number of the
    attempt, which goes on where ``outcome`` is None.
    """
    headline = of.configuration.evaluation.headline
    iterations = []
    for iteration, distance in enumerate(distances):
        metrics = [Metric(headline, distance, "noise_free", np.full(4, distance))]
        for name, values in (train or {}).items():
            metrics += [Metric(name, value) for value in values[:iteration][iteration - 1 :]]
        iterations.append(metrics)
    return store_attempt(store, of, iterations, outcome, provenance, error)


def add_pictures(store: Store, of: Cell, attempt: int, frames: NDArray[Any] | None = None) -> None:
    """Three episodes of four frames, two of them reconstructed, two predicted; twelve latents."""
    stream = np.random.default_rng(of.seed)
    if frames is None:
        frames = stream.integers(0, 50, (3, 4, 2, 32, 32), dtype=np.uint8)
    folder = store.folder(of.hash)
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {
        "animation": {"frames": frames, "kind": np.array("image")},
        "reconstruction": {"original": frames[0, :2], "reconstruction": frames[0, :2] / 2},
        "prediction": {"original": frames[0, 1:3], "prediction": frames[0, :2]},
        "latents": {
            "latents": stream.normal(size=(12, 4)).astype(np.float32),
            "truth": stream.normal(size=(12, 2)).astype(np.float32),
            "names": np.array(["x", "y"]),
        },
    }
    for kind, content in arrays.items():
        np.savez(folder / f"{kind}.npz", allow_pickle=False, **content)
        store.add_artifact(of.hash, attempt, kind, folder / f"{kind}.npz", 3)


def database(path: Path) -> Store:
    return Store.open(str(path / "solar.db"))
