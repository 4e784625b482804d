"""Checkpoint files: plain data and tensors, whole or not there, checked before they are used.

A file's SHA-256 is that of the bytes that were meant, taken before they reach the disk; a single
flipped bit would otherwise load as wrong weights in silence.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections import OrderedDict
from pathlib import Path
from typing import Any

from solar_cli.errors import SolarError

PLAIN = (str, bytes, int, float, bool, type(None))


class CorruptCheckpoint(SolarError):
    """The file is missing, not the one that was committed, or holds more than plain data."""


def save(state: dict[str, Any], path: Path) -> tuple[str, int]:
    """Write ``state`` to ``path`` and return the file's SHA-256 and size in bytes.

    The file is written beside, flushed to the disk and renamed, so that ``path`` is never half a
    file. ``state`` may hold dicts, lists, tuples, text, bytes, numbers, ``None`` and tensors.
    Raises `TypeError` for anything else, as `load` would refuse it, and `SolarError` when the disk
    is full.
    """
    import torch

    _check(state, "state")
    buffer = io.BytesIO()
    torch.save(state, buffer)
    data = buffer.getbuffer()
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        beside.rename(path)
        _flush_folder(path.parent)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise SolarError(
            f"checkpoint {path} cannot be written ({error.strerror}): the one before it is kept; "
            "make room or change the folder's rights, then run again"
        ) from error
    return hashlib.sha256(data).hexdigest(), data.nbytes


def load(path: Path, sha256: str) -> dict[str, Any]:
    """Read the state that `save` wrote, tensors on the CPU; nothing in the file is executed.

    Raises `CorruptCheckpoint` for a missing file and for any other content than that of ``sha256``.
    """
    import torch

    try:
        data = path.read_bytes()
    except OSError as error:
        raise CorruptCheckpoint(
            f"checkpoint {path} cannot be read ({error.strerror}): the one before it has to do"
        ) from error
    if hashlib.sha256(data).hexdigest() != sha256:
        raise CorruptCheckpoint(
            f"checkpoint {path} is damaged (its SHA-256 is another): the one before it has to do"
        )
    try:
        state: dict[str, Any] = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds, depending on where the file is wrong
        raise CorruptCheckpoint(
            f"checkpoint {path} holds more than plain data and is refused "
            f"({type(error).__name__}): the one before it has to do"
        ) from error
    return state


def _check(value: Any, where: str) -> None:
    """Refuse what could be written but not be loaded again, naming where it is."""
    import torch

    if type(value) in (dict, OrderedDict):
        for key, item in value.items():
            _check(key, f"a key of {where}")
            _check(item, f"{where}[{key!r}]")
    elif type(value) in (list, tuple):
        for index, item in enumerate(value):
            _check(item, f"{where}[{index}]")
    elif type(value) not in PLAIN and not isinstance(value, torch.Tensor):
        raise TypeError(f"{where} is a {type(value).__name__}: make it plain data or a tensor")


def _flush_folder(folder: Path) -> None:
    """See the renaming itself to the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
