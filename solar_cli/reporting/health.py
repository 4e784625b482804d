"""Is learning healthy? The metrics of every iteration that a person should watch, over seeds."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from solar_cli.reporting.curves import Curve
from solar_cli.reporting.signs import SIGNS, TRAIN
from solar_cli.reporting.statistics import Array
from solar_cli.reporting.tables import number
from solar_cli.store.store import Store

MODEL = "model"
SPLITS = (TRAIN, MODEL)
SPARK_WIDTH, SPARK_HEIGHT = 100, 20


@dataclass(frozen=True)
class Vital:
    """One metric of one curve."""

    mean: float
    """over seeds, of each seed's newest value"""
    low: float
    high: float
    spark: str
    """points of an SVG polyline in a box of 100 x 20: its mean over seeds against iterations"""

    def __str__(self) -> str:
        """``0.98 (0.95 to 0.99)``; a value that is not finite is not hidden."""
        if self.low == self.high:
            return number(self.mean)
        return f"{number(self.mean)} ({number(self.low)} to {number(self.high)})"


@dataclass(frozen=True)
class Chart:
    """The vitals of some curves side by side."""

    labels: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Vital | None, ...]], ...]
    """name of the metric and one entry a curve, None where the method has no such metric"""

    @property
    def warnings(self) -> list[str]:
        """One line for each sign of each curve that a seed has."""
        rows = dict(self.rows)
        return [
            f"{label}: in at least one seed {sign.says}"
            for sign in SIGNS
            for label, vital in zip(self.labels, rows.get(_plain(sign.metric), ()), strict=False)
            if vital is not None and sign.bad(vital.low, vital.high)
        ]


def chart(store: Store, curves: Sequence[Curve]) -> Chart:
    """The vitals of the latest iterations that have them."""
    columns = [_vitals(store, curve) for curve in curves]
    names = sorted(
        {name for column in columns for name in column},
        key=lambda name: (SPLITS.index(name[0]), name[1]),
    )
    headlines = {curve.measure.headline for curve in curves}
    return Chart(
        tuple(curve.label for curve in curves),
        tuple(
            (
                _title(name, split, headlines),
                tuple(column.get((split, name)) for column in columns),
            )
            for split, name in names
        ),
    )


def _title(name: str, split: str, headlines: Collection[str]) -> str:
    """The headline measure of the learner's own noisy episodes is not the headline: it says so."""
    plain = _plain(name)
    if split == MODEL:
        return f"{plain} (judged on the truth)"
    return f"{plain} ({split})" if name in headlines else plain


def _plain(name: str) -> str:
    return name.replace("_", " ")


def _vitals(store: Store, curve: Curve) -> dict[tuple[str, str], Vital]:
    series: dict[tuple[str, str], dict[str, dict[int, float]]] = defaultdict(
        lambda: defaultdict(dict)
    )
    hashes = [seed.record.hash for seed in curve.seeds]
    for row in store.metrics(hashes=hashes, splits=SPLITS):
        series[row["split"], row["name"]][row["cell"]][row["iteration"]] = row["value"]
    return {key: _vital(list(cells.values())) for key, cells in series.items()}


def _vital(seeds: Sequence[dict[int, float]]) -> Vital:
    """From iteration -> value of each seed."""
    newest = np.array([values[max(values)] for values in seeds])
    iterations = sorted({iteration for values in seeds for iteration in values})
    means = np.array([np.mean([values[i] for values in seeds if i in values]) for i in iterations])
    with np.errstate(invalid="ignore"):
        mean = float(newest.mean())
    return Vital(mean, float(newest.min()), float(newest.max()), spark(iterations, means))


def spark(iterations: Sequence[int], values: Array) -> str:
    """Points ``x,y x,y ...`` of a line through the finite values; empty below two of them."""
    finite = np.isfinite(values)
    if finite.sum() < 2:
        return ""
    x = np.asarray(iterations, dtype=np.float64)[finite]
    y = values[finite]
    across = (x - x[0]) / (x[-1] - x[0]) * SPARK_WIDTH
    span = np.ptp(y)
    up = (y - y.min()) / span if span > 0 else np.full(len(y), 0.5)
    return " ".join(
        f"{a:.1f},{SPARK_HEIGHT * (1 - b):.1f}" for a, b in zip(across, up, strict=True)
    )
