"""The public data frame, and what an export must not lose."""

import io
import json

import numpy as np
import pandas as pd
import pytest
from hand_made import cell, database

from solar_cli.errors import UsageError
from solar_cli.reporting.frames import COLUMNS, export, frame, load
from solar_cli.store.records import Metric, Owner

ODD = {"third": 1 / 3, "tiny": 5e-324, "nan": np.nan, "up": np.inf, "down": -np.inf}
KINDS = {"third": "finite", "tiny": "finite", "nan": "nan", "up": "+inf", "down": "-inf"}


@pytest.fixture
def stored(tmp_path):
    """The address of a database with one cell that measured `ODD`."""
    of = cell(seed=7)
    with database(tmp_path) as store:
        store.add([of])
        attempt = store.claim(of.hash, Owner.current(), 10, {})
        metrics = [Metric(name, value, "model") for name, value in ODD.items()]
        metrics.append(Metric("final_distance", 0.5, "noise_free", np.array([0.25, 0.75])))
        totals = {"episodes": 60, "steps": 3000, "simulated_seconds": 3000.0, "seconds": 9.0}
        store.commit(of.hash, attempt, iteration=1, **totals, metrics=metrics)
    return str(tmp_path / "solar.db")


def values(frame):
    return dict(zip(frame["name"], frame["value"], strict=True))


def exported(frame, format):
    file = io.BytesIO()
    export(frame, format, file)
    file.seek(0)
    return file


def test_a_row_a_metric_with_the_promised_columns(stored):
    loaded = load(stored)
    assert list(loaded.columns) == [
        *("cell", "task", "method", "variant", "seed", "iteration"),
        *("episodes", "steps", "split", "name", "value", "kind"),
    ]
    row = loaded[loaded["name"] == "final_distance"].iloc[0]
    assert row["cell"] == cell(seed=7).hash
    assert row.drop("cell").tolist() == [
        *("nav", "solar", "default", 7, 1, 60, 3000, "noise_free", "final_distance", 0.5, "finite"),
    ]
    assert values(loaded)["final_distance"] == 0.5
    np.testing.assert_equal({name: values(loaded)[name] for name in ODD}, ODD)
    assert {n: k for n, k in zip(loaded["name"], loaded["kind"], strict=True) if n in ODD} == KINDS


def test_an_empty_store_gives_the_same_columns_and_types(tmp_path, stored):
    with database(tmp_path / "empty") as store:
        empty = frame(store)
    assert len(empty) == 0
    assert empty.dtypes.to_dict() == load(stored).dtypes.to_dict()


def test_json_writes_null_and_the_kind_for_what_is_not_finite(stored):
    entries = json.load(exported(load(stored), "json"), parse_constant=pytest.fail)
    assert [list(entry) for entry in entries] == [COLUMNS] * 6
    found = {entry["name"]: entry for entry in entries}
    for name, value in ODD.items():
        assert found[name]["kind"] == KINDS[name]
        assert found[name]["value"] == (value if KINDS[name] == "finite" else None)


def test_csv_and_parquet_lose_no_digit(stored):
    original = load(stored)
    csv = pd.read_csv(exported(original, "csv"), keep_default_na=False)
    csv["value"] = csv["value"].astype(float)
    pd.testing.assert_frame_equal(csv, original, check_exact=True, check_dtype=False)
    parquet = pd.read_parquet(exported(original, "parquet"))
    pd.testing.assert_frame_equal(parquet, original, check_exact=True)


def test_an_empty_export_is_still_valid(tmp_path):
    with database(tmp_path) as store:
        empty = frame(store)
    assert json.load(exported(empty, "json")) == []
    assert exported(empty, "csv").read().decode() == ",".join(COLUMNS) + "\n"


def test_a_selection_is_what_the_store_selects(stored, tmp_path):
    with database(tmp_path) as store:
        assert set(frame(store, splits=["model"])["name"]) == set(ODD)


def test_an_unknown_format_is_named(stored):
    with pytest.raises(UsageError, match=r"'jason'.*'json'"):
        export(load(stored), "jason", io.BytesIO())
