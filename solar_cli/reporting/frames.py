"""The stored metrics as one data frame, and its export: public and stable.

| column | meaning |
|---|---|
| ``cell`` | hash of the cell: task, method, variant, seed and configuration |
| ``task``, ``method``, ``variant``, ``seed`` | its names |
| ``iteration`` | of the method; 0 is the initial policy |
| ``episodes``, ``steps`` | collected when it was measured |
| ``split`` | ``train`` (collected episodes), ``noise_free`` (evaluation) or ``model`` |
| ``name`` | of the measure, such as ``final_distance`` |
| ``value`` | the number; of an evaluation the mean over its episodes |
| ``kind`` | ``finite``, ``nan``, ``+inf`` or ``-inf`` |
"""

from __future__ import annotations

import json
from typing import IO, Any, Literal, get_args

import pandas as pd

from solar_cli.errors import SolarError, UsageError, nearest
from solar_cli.store.store import Store

DTYPES = {
    "cell": "str",
    "task": "str",
    "method": "str",
    "variant": "str",
    "seed": "int64",
    "iteration": "int64",
    "episodes": "int64",
    "steps": "int64",
    "split": "str",
    "name": "str",
    "value": "float64",
    "kind": "str",
}
COLUMNS = list(DTYPES)

Format = Literal["csv", "json", "parquet"]


def load(db: str | None = None) -> pd.DataFrame:
    """All stored metrics, one row a metric, with the columns of `DTYPES`.

    ``db`` is a database address as in ``--db``; None takes ``SOLAR_DB``, else ``runs/solar.db``.
    Raises `UsageError` for what is no Solar database.
    """
    with Store.open(db, read_only=True) as store:
        return frame(store)


def frame(store: Store, **selection: Any) -> pd.DataFrame:
    """The metrics of an open store; ``selection`` as in `Store.metrics` (tasks, methods, ...)."""
    rows = store.metrics(**selection)
    columns = {name: [row[name] for row in rows] for name in COLUMNS}
    return pd.DataFrame(columns).astype(DTYPES)


def export(frame: pd.DataFrame, format: Format, file: IO[bytes]) -> None:
    """Write a frame of `load` to a binary file, every float with all of its digits.

    CSV writes ``nan``, ``inf`` and ``-inf``; JSON, which lacks them, null beside their ``kind``.
    Raises `UsageError` for an unknown format, `SolarError` where Parquet's package is missing.
    """
    if format == "csv":
        frame.to_csv(file, index=False, na_rep="nan", lineterminator="\n")
    elif format == "json":
        _write_json(frame, file)
    elif format == "parquet":
        try:
            frame.to_parquet(file, index=False)
        except ImportError as error:
            raise SolarError(
                "export to parquet: the package pyarrow is missing: "
                "pip install 'solar-cli[parquet]'"
            ) from error
    else:
        raise UsageError(f"--format {format!r}: {nearest(format, get_args(Format))}")


def _write_json(frame: pd.DataFrame, file: IO[bytes]) -> None:
    """One array, one line an object, written as it goes."""
    start = b"[\n"
    for row in zip(*(frame[name].tolist() for name in COLUMNS), strict=True):
        entry = dict(zip(COLUMNS, row, strict=True))
        if entry["kind"] != "finite":
            entry["value"] = None
        file.write(start + json.dumps(entry, ensure_ascii=False, allow_nan=False).encode())
        start = b",\n"
    file.write(b"\n]\n" if start == b",\n" else b"[]\n")
