"""A checkpoint is the one that was written, or it is refused."""

import errno
import hashlib
import io
import os
import signal
import subprocess
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from solar_cli.errors import SolarError
from solar_cli.store.checkpoints import CorruptCheckpoint, load, save

STATE: dict[str, Any] = {
    "model": OrderedDict(weight=torch.arange(6, dtype=torch.float64).reshape(2, 3)),
    "iteration": 3,
    "bounds": (0.3, None, [True, b"\x00", "text"]),
    7: float("nan"),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, bytes]:
    """A checkpoint: (path, SHA-256, content)."""
    path = tmp_path_factory.mktemp("checkpoints") / "3.pt"
    sha256, size = save(STATE, path)
    data = path.read_bytes()
    assert (sha256, size) == (hashlib.sha256(data).hexdigest(), len(data))
    return path, sha256, data


def test_a_state_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    path = tmp_path / "new" / "3.pt"
    sha256, _ = save(STATE, path)
    state = load(path, sha256)
    assert list(state) == list(STATE)
    weight = state["model"]["weight"]
    assert weight.dtype == torch.float64
    assert torch.equal(weight, STATE["model"]["weight"])
    assert state["bounds"] == STATE["bounds"]
    assert np.isnan(state[7])
    assert [each.name for each in path.parent.iterdir()] == ["3.pt"]


@settings(max_examples=200, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_one_flipped_bit_anywhere_is_detected(
    written: tuple[Path, str, bytes], place: float, bit: int
) -> None:
    path, sha256, data = written
    flipped = bytearray(data)
    flipped[int(place * len(data))] ^= 1 << bit
    damaged = path.with_name("flipped.pt")
    damaged.write_bytes(flipped)
    with pytest.raises(CorruptCheckpoint, match="damaged"):
        load(damaged, sha256)


@settings(max_examples=50, deadline=None)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_truncated_file_is_detected(written: tuple[Path, str, bytes], share: float) -> None:
    path, sha256, data = written
    damaged = path.with_name("short.pt")
    damaged.write_bytes(data[: int(share * len(data))])
    with pytest.raises(CorruptCheckpoint, match="damaged"):
        load(damaged, sha256)


def test_a_missing_file_is_detected(tmp_path: Path) -> None:
    with pytest.raises(CorruptCheckpoint, match="cannot be read"):
        load(tmp_path / "none.pt", "0" * 64)


class Malicious:
    """What runs a command when it is unpickled."""

    def __init__(self, trap: Path) -> None:
        self.trap = trap

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return os.mkdir, (str(self.trap),)


def test_a_file_that_would_run_code_is_refused_though_its_hash_is_right(tmp_path: Path) -> None:
    trap = tmp_path / "trap"
    buffer = io.BytesIO()
    torch.save({"model": Malicious(trap)}, buffer)
    for data in (buffer.getvalue(), b"not a checkpoint", zip_of_nothing()):
        path = tmp_path / "malicious.pt"
        path.write_bytes(data)
        with pytest.raises(CorruptCheckpoint, match="refused") as caught:
            load(path, hashlib.sha256(data).hexdigest())
        assert "\n" not in str(caught.value)
    assert not trap.exists()
    torch.load(io.BytesIO(buffer.getvalue()), weights_only=False)  # the trap does work
    assert trap.exists()


def zip_of_nothing() -> bytes:
    buffer = io.BytesIO()
    zipfile.ZipFile(buffer, "w").close()
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("state", "where"),
    [
        ({"policy": {"std": np.zeros(2)}}, r"state\['policy'\]\['std'\] is a ndarray"),
        ({"seconds": [0.0, np.float64(1.0)]}, r"state\['seconds'\]\[1\] is a float64"),
        ({("a", Path("b")): 1}, "a key of state"),
    ],
)
def test_what_could_not_be_loaded_again_is_not_saved(
    state: dict[Any, Any], where: str, tmp_path: Path
) -> None:
    with pytest.raises(TypeError, match=where):
        save(state, tmp_path / "3.pt")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_keeps_the_file_of_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "3.pt"
    sha256, _ = save(STATE, path)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SolarError, match="No space left"):
        save({"iteration": 4}, path)
    assert load(path, sha256)["iteration"] == 3
    assert [each.name for each in tmp_path.iterdir()] == ["3.pt"]


def test_a_writer_killed_before_the_renaming_leaves_the_file_of_before(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    path = tmp_path / "3.pt"
    sha256, _ = save(STATE, path)
    script = (
        "import os, pathlib, sys; from solar_cli.store.checkpoints import save; "
        "os.fsync = lambda handle: os.kill(os.getpid(), 9); "
        "save({'iteration': 4}, pathlib.Path(sys.argv[1]))"
    )
    run = subprocess.run([sys.executable, "-c", script, str(path)], env=environment, check=False)
    assert run.returncode == -signal.SIGKILL
    assert load(path, sha256)["iteration"] == 3
