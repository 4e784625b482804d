"""What two runs of a cell must have in common to the last bit."""

import hashlib
from pathlib import Path
from typing import Any

import torch

from solar_cli.store.store import Store

OF_THE_MACHINE = ("seconds", "peak_memory")
"""how metrics begin that measure the machine, not what is learned"""


def fingerprint(store: Store, cell: str) -> dict[str, str]:
    """SHA-256 of the metric rows and of the learner's final state; time and memory are left out."""
    return {"metrics": metric_digest(store, cell), "state": state_digest(store, cell)}


def metric_digest(store: Store, cell: str, splits: tuple[str, ...] = ()) -> str:
    digest = hashlib.sha256()
    for row in store.metrics(hashes=[cell], splits=splits, values=True):
        if row["name"].startswith(OF_THE_MACHINE):
            continue
        values = row["values"]
        parts = [row[key] for key in ("iteration", "episodes", "steps", "split", "name", "kind")]
        digest.update(repr([*parts, float(row["value"]).hex()]).encode())
        digest.update(b"" if values is None else values.tobytes())
    return digest.hexdigest()


def state_digest(
    store: Store, cell: str, parts: tuple[str, ...] = ("learner", "environment")
) -> str:
    """Of the newest checkpoint, which the end of a run leaves complete."""
    newest = store.checkpoints(cell)[0]
    assert newest.complete
    state = torch.load(store.folder(cell) / newest.path, weights_only=True)
    digest = hashlib.sha256()
    _feed(digest, [state[part] for part in parts])
    return digest.hexdigest()


def _feed(digest: Any, value: Any) -> None:
    if isinstance(value, torch.Tensor):
        digest.update(f"{value.dtype}{tuple(value.shape)}".encode())
        digest.update(value.contiguous().flatten().view(torch.uint8).numpy().tobytes())
    elif isinstance(value, dict):
        for key in sorted(value, key=repr):
            digest.update(repr(key).encode())
            _feed(digest, value[key])
    elif isinstance(value, list | tuple):
        for item in value:
            _feed(digest, item)
    else:
        digest.update(repr(value).encode())


def files_of(store: Store, cell: str) -> set[Path]:
    """The checkpoint files that lie on the disk."""
    return set((store.folder(cell) / "checkpoints").iterdir())
