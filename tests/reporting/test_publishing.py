"""A report's folder: only what an earlier report wrote is ever replaced or removed."""

import json
import os

import pytest

from solar_cli.errors import SolarError, UsageError
from solar_cli.reporting.publishing import LIST, publish


def files(folder):
    return sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and path.name != LIST
    )


def test_an_earlier_report_goes_and_foreign_files_stay(tmp_path):
    publish(tmp_path, {"index.html": b"1", "old/curve.png": b"1", "nav/curve.png": b"1"})
    (tmp_path / "mine.txt").write_text("foreign")
    (tmp_path / "nav" / "notes.md").write_text("foreign")
    written = publish(tmp_path, {"index.html": b"2", "car/curve.png": b"2"})
    assert written == [tmp_path / "index.html", tmp_path / "car" / "curve.png"]
    assert files(tmp_path) == ["car/curve.png", "index.html", "mine.txt", "nav/notes.md"]
    assert (tmp_path / "index.html").read_bytes() == b"2"
    assert not (tmp_path / "old").exists()


def test_a_foreign_file_in_the_way_is_refused_before_anything_is_written(tmp_path):
    (tmp_path / "index.html").write_text("foreign")
    with pytest.raises(UsageError, match=r"index\.html.*not written by"):
        publish(tmp_path, {"nav/curve.png": b"", "index.html": b""})
    assert files(tmp_path) == ["index.html"]
    assert (tmp_path / "index.html").read_text() == "foreign"


def test_a_list_that_points_outside_removes_nothing_there(tmp_path):
    outside = tmp_path / "outside.txt"
    outside.write_text("foreign")
    out = tmp_path / "out"
    out.mkdir()
    (out / LIST).write_text(json.dumps(["../outside.txt", str(outside), "index.html"]))
    publish(out, {"index.html": b""})
    assert outside.exists()


def test_a_link_that_leads_outside_is_not_followed(tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    out = tmp_path / "out"
    out.mkdir()
    (out / "nav").symlink_to(elsewhere)
    with pytest.raises(UsageError, match="leads out"):
        publish(out, {"nav/curve.png": b""})
    assert files(elsewhere) == []


def test_a_damaged_list_is_said(tmp_path):
    (tmp_path / LIST).write_text("{")
    with pytest.raises(SolarError, match="does not list"):
        publish(tmp_path, {"index.html": b""})


def test_a_folder_that_cannot_be_made_is_bad_input(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="cannot be written"):
        publish(tmp_path / "file", {"index.html": b""})


def test_a_report_that_was_cut_short_is_cleaned_up_by_the_next(tmp_path, monkeypatch):
    replace = os.replace

    def full(source, target):
        if "second" in str(target):
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr("pathlib.os.replace", full)
    with pytest.raises(UsageError, match="No space left"):
        publish(tmp_path, {"first": b"1", "second": b"1"})
    monkeypatch.undo()
    assert files(tmp_path) == ["first"]
    publish(tmp_path, {"third": b"1"})
    assert files(tmp_path) == ["third"]
