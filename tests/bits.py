"""What must be the same to the last bit: plain data and tensors, and two runs of a cell."""

import hashlib
import io
from pathlib import Path
from typing import Any

import torch

from solar_cli.store.store import Store

OF_THE_MACHINE = ("seconds", "peak_memory")
"""how metrics begin that measure the machine, not what is learned"""


def digest(value: Any) -> str:
    """SHA-256 of plain data and tensors, to the last bit; what is of the machine is left out."""
    found = hashlib.sha256()

    def feed(part: Any) -> None:
        if isinstance(part, torch.Tensor):
            found.update(f"{part.dtype}{tuple(part.shape)}".encode())
            found.update(part.detach().contiguous().flatten().view(torch.uint8).numpy().tobytes())
        elif isinstance(part, dict):
            for key in sorted(part, key=repr):
                if not str(key).startswith(OF_THE_MACHINE):
                    found.update(repr(key).encode())
                    feed(part[key])
        elif isinstance(part, list | tuple):
            found.update(f"[{len(part)}".encode())
            for item in part:
                feed(item)
        else:
            found.update(repr(part).encode())

    feed(value)
    return found.hexdigest()


def through_a_file(state: Any) -> Any:
    """What a checkpoint gives back."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


def fingerprint(store: Store, cell: str) -> dict[str, str]:
    """SHA-256 of the metric rows and of the learner's final state; time and memory are left out."""
    return {"metrics": metric_digest(store, cell), "state": state_digest(store, cell)}


def metric_digest(store: Store, cell: str, splits: tuple[str, ...] = ()) -> str:
    found = hashlib.sha256()
    for row in store.metrics(hashes=[cell], splits=splits, values=True):
        if row["name"].startswith(OF_THE_MACHINE):
            continue
        values = row["values"]
        parts = [row[key] for key in ("iteration", "episodes", "steps", "split", "name", "kind")]
        found.update(repr([*parts, float(row["value"]).hex()]).encode())
        found.update(b"" if values is None else values.tobytes())
    return found.hexdigest()


def state_digest(
    store: Store, cell: str, parts: tuple[str, ...] = ("learner", "environment")
) -> str:
    """Of the newest checkpoint, which the end of a run leaves complete."""
    newest = store.checkpoints(cell)[0]
    assert newest.complete
    state = torch.load(store.folder(cell) / newest.path, weights_only=True)
    return digest([state[part] for part in parts])


def files_of(store: Store, cell: str) -> set[Path]:
    """The checkpoint files that lie on the disk."""
    return set((store.folder(cell) / "checkpoints").iterdir())
