"""What would spoil a run is seen before it starts, with what to do about it."""

import os
import shutil
from collections import namedtuple
from pathlib import Path

import pytest

from solar_cli.experiment import machine
from solar_cli.experiment.machine import Check, Verdict, checks, folder, judged
from solar_cli.store.store import Store

Usage = namedtuple("Usage", "total used free")


def verdicts(found: list[Check]) -> dict[str, Verdict]:
    """By name; whatever is not good says what to do."""
    assert all(check.advice for check in found if check.verdict is not Verdict.GOOD)
    return {check.name: check.verdict for check in found}


def test_a_database_that_is_not_there_yet_is_no_fault(tmp_path: Path) -> None:
    found = list(checks(str(tmp_path / "runs" / "solar.db")))
    assert Verdict.BAD not in verdicts(found).values()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "empty.db").touch()  # as a disk that was full leaves it
    assert Verdict.BAD not in verdicts(list(machine.store(str(tmp_path / "empty.db")))).values()


def test_what_is_no_database_is_bad(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("my notes\n" * 100)
    assert verdicts(list(machine.store(str(tmp_path / "notes.txt"))))["database"] is Verdict.BAD


def test_a_database_that_cannot_be_written_is_bad(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To root every file is writable."""
    Store.open(str(tmp_path / "solar.db")).close()
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    first = next(machine.store(str(tmp_path / "solar.db")))
    assert (first.name, first.verdict) == ("database", Verdict.BAD)
    assert "read-only" in first.found


@pytest.mark.parametrize(
    ("name", "found", "verdict"),
    [
        ("integrity", "ok", Verdict.GOOD),
        ("integrity", "row 3 missing from index", Verdict.BAD),
        ("references", "metric", Verdict.BAD),
        ("journal", "delete", Verdict.GOOD),
        ("journal", "wal", Verdict.DOUBTFUL),
    ],
)
def test_what_the_database_says_of_itself_is_judged(
    name: str, found: str, verdict: Verdict
) -> None:
    assert verdicts([judged(name, found)]) == {name: verdict}


def test_network_file_systems_and_full_disks_are_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind, free, expected in (
        ("ext4", machine.LEAST_FREE, Verdict.GOOD),
        ("nfs4", machine.LEAST_FREE - 1, Verdict.DOUBTFUL),
    ):
        monkeypatch.setattr(machine, "file_system", lambda path, kind=kind: kind)
        monkeypatch.setattr(shutil, "disk_usage", lambda path, free=free: Usage(free, 0, free))
        seen = verdicts(list(folder(tmp_path / "new" / "runs")))
        assert seen == {"folder": Verdict.GOOD, "file system": expected, "disk": expected}


def test_a_folder_that_cannot_be_written_is_bad(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(**_: object) -> None:
        raise PermissionError(13, "Permission denied")

    # Rights do not bind root, which tests may run as: what the system would say is said for it.
    monkeypatch.setattr("tempfile.TemporaryFile", refused)
    assert verdicts(list(folder(tmp_path)))["folder"] is Verdict.BAD
