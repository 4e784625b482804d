"""A whole report on a real small database."""

import csv
import shutil
from html.parser import HTMLParser

import pytest
from hand_made import OTHER_CODE, add_pictures, cell, compute, database

from solar_cli.errors import SolarError
from solar_cli.experiment.provenance import code
from solar_cli.reporting.report import file_names, report
from solar_cli.settings import Cell, Configuration, EvaluationSettings
from solar_cli.store.records import Outcome
from solar_cli.store.store import Store

SCRIPT = "<script>alert(1)</script>"
VOID = {"meta", "img", "source", "br", "hr", "input", "link"}


class Page(HTMLParser):
    """Tags, attributes and text of a page; unbalanced tags are an error."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(the report, its folder): two methods of three seeds, one of them stale, one diverged."""
    folder = tmp_path_factory.mktemp("report")
    present = code()
    with database(folder) as store:
        for seed, final in enumerate([0.4, 0.2, 0.3]):
            of = cell("solar", seed)
            attempt = compute(store, of, [1.0, 0.6, final], None, present, train={"kl": [0.5, 0.4]})
            add_pictures(store, of, attempt)
            store.end(of.hash, attempt, Outcome.FINISHED)
            diverged = Outcome.DIVERGED if seed == 0 else Outcome.FINISHED
            error = SCRIPT if seed == 0 else None
            compute(store, cell("vae", seed), [1.0, 0.9, 0.8], diverged, OTHER_CODE, error)
        store.add([cell("solar", 7, "paper")])
        out = folder / "out"
        return report(store, out), out


def test_a_report_has_its_files(made):
    written, out = made
    names = {path.relative_to(out).as_posix() for path in written.paths}
    assert names == {
        "index.html",
        *(f"nav/curve.{kind}" for kind in ("png", "svg", "pdf")),
        *(f"nav/table.{kind}" for kind in ("md", "csv", "tex")),
        "nav/evaluations.csv",
        "nav/solar.gif",
        "nav/solar-reconstruction.png",
        "nav/solar-prediction.png",
        "nav/solar-latents.png",
    }
    assert all(path.stat().st_size > 0 for path in written.paths)
    assert written.index == out / "index.html"


def test_the_headline_lines_say_measure_episodes_seeds_and_code(made):
    solar, vae = made[0].lines
    assert solar.startswith("nav solar: final_distance 0.3 ± 0.1 ")
    assert "after 20 episodes, seeds: 3, code: " in solar
    assert "seeds: 3 (1 diverged), code: bbbbbbb" in vae


def test_a_curve_that_a_seed_has_just_begun_to_cut_is_told_of_where_it_is_printed(tmp_path):
    with database(tmp_path) as store:
        for seed in (0, 1):
            compute(store, cell("solar", seed), [1.0, 0.6, 0.2])
        whole = report(store, tmp_path / "out").lines
        compute(store, cell("solar", 2), [1.0], None)
        headline, said = report(store, tmp_path / "out").lines
    assert len(whole) == 1
    assert "after 0 episodes, seeds: 3 (1 unfinished)" in headline
    ends = "ends at 0 of 20 episodes, where its shortest seed ends (seed 2)"
    assert said == f"nav solar: {ends}"
    assert f"solar: {ends}" in (tmp_path / "out" / "index.html").read_text()


def test_a_report_without_the_files_of_the_cells_keeps_its_numbers(tmp_path):
    with database(tmp_path) as store:
        of = cell("solar", 0)
        attempt = compute(store, of, [1.0, 0.6], None)
        add_pictures(store, of, attempt)
        store.end(of.hash, attempt, Outcome.FINISHED)
        shutil.rmtree(store.home / "cells")
        (headline,) = report(store, tmp_path / "out").lines
    text = (tmp_path / "out" / "index.html").read_text()
    assert "final_distance 0.6" in headline
    assert "put the cell&#39;s files beside the database" in text
    assert "--redo" not in text
    assert str(tmp_path) not in text


def test_the_page_says_what_stands_in_for_the_default_solar(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell("solar", 0, "fine-tuned"), [1.0, 0.6])
        compute(store, cell("vae", 0), [1.0, 0.6])
        report(store, tmp_path / "out")
        page = (tmp_path / "out" / "index.html").read_text()
        assert "solar:fine-tuned stands in for it" in page
        compute(store, cell("solar", 0), [1.0, 0.6])
        report(store, tmp_path / "out")
        assert "stands in" not in (tmp_path / "out" / "index.html").read_text()


def test_evaluations_hold_every_point_with_all_digits(made):
    with (made[1] / "nav" / "evaluations.csv").open() as file:
        rows = list(csv.DictReader(file))
    points = [
        (r["method"], int(r["seed"]), int(r["episodes"]), float(r["final_distance"])) for r in rows
    ]
    assert len(points) == 18
    assert ("solar", 1, 20, 0.2) in points


def test_the_page_is_whole_needs_no_network_and_no_script(made):
    page = Page((made[1] / "index.html").read_text(encoding="utf-8"))
    for tag, attributes in page.tags:
        assert tag not in {"script", "link", "iframe", "object", "base"}
        for name, value in attributes.items():
            assert not name.startswith("on")
            if name in ("src", "srcset"):
                assert value.startswith("data:image/")
            if name == "href":
                assert value.startswith("#")
    anchors = {a["href"][1:] for _, a in page.tags if "href" in a}
    assert anchors <= {a["id"] for _, a in page.tags if "id" in a}
    assert "url(" not in page.text


def test_the_page_shows_results_failures_health_and_provenance(made):
    text = Page((made[1] / "index.html").read_text(encoding="utf-8")).text
    assert "0.3 ± 0.1" in text
    assert SCRIPT in text  # as text: the cause of a divergence
    assert "computed by bbbbbbb, not by" in text  # the stale cells
    assert "kl" in text
    assert "different code" not in text
    assert "nav/solar:paper seed 7 (pending)" in text
    assert "b" * 40 in text


def test_a_second_report_of_the_same_store_has_the_same_bytes(made):
    _, out = made
    before = {path: path.read_bytes() for path in made[0].paths}
    with Store.open(str(out.parent / "solar.db"), read_only=True) as store:
        again = report(store, out)
    assert {path: path.read_bytes() for path in again.paths} == before


def test_names_with_markup_are_inert_and_stay_inside_the_folder(tmp_path):
    parts = cell().configuration
    odd = "<img src=x onerror=alert(1)>"
    evaluation = EvaluationSettings(headline=odd, unit=odd, levels=(0.5,))
    configuration = Configuration.model_construct(
        task=parts.task, evaluation=evaluation, method=parts.method
    )
    with database(tmp_path) as store:
        for task in ("../../up", odd):
            of = Cell(task, "solar", odd, 0, configuration)
            compute(store, of, [1.0, 0.5], train={odd: [1.0]}, error=odd, outcome=Outcome.FAILED)
        written = report(store, tmp_path / "out")
    for path in written.paths:
        assert path.resolve().is_relative_to((tmp_path / "out").resolve())
    page = Page(written.index.read_text(encoding="utf-8"))
    assert not any("onerror" in attributes for _, attributes in page.tags)
    assert odd in page.text
    for table in (tmp_path / "out").rglob("table.md"):
        assert "<img" not in table.read_text(encoding="utf-8")


def test_file_names_are_distinct_and_plain():
    names = file_names(["solar:paper", "solar-paper", "../..", "", "Übung", "nav@3f2a"])
    assert names[0] == "solar-paper"
    assert names[-1] == "nav-3f2a"
    assert len(set(names)) == len(names)
    assert all(name and not name.startswith((".", "-")) and "/" not in name for name in names)


@pytest.mark.parametrize("pending", [[], [cell()]], ids=["no cell", "no evaluation"])
def test_an_empty_store_says_what_to_run_first(tmp_path, pending):
    with database(tmp_path) as store:
        store.add(pending)
        with pytest.raises(SolarError, match=r"nothing to report.*solar run --task nav"):
            report(store, tmp_path / "out")
    assert not (tmp_path / "out").exists()
