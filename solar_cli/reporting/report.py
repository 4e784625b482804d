"""``solar report``: everything about a store, written into a folder."""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from solar_cli.errors import SolarError
from solar_cli.experiment.provenance import code
from solar_cli.reporting.curves import Problem, problems
from solar_cli.reporting.evidence import code_label, cut
from solar_cli.reporting.page import page
from solar_cli.reporting.publishing import publish
from solar_cli.reporting.sections import MEMORY, Section, cell_lines, origins, section
from solar_cli.reporting.summary import flat, line
from solar_cli.store.store import Store


@dataclass(frozen=True)
class Report:
    """What was written."""

    index: Path
    """the HTML page"""
    paths: tuple[Path, ...]
    """all files, the page among them"""
    lines: tuple[str, ...]
    """the headline of each curve, and where one ends before some of its seeds"""


def report(store: Store, out: Path) -> Report:
    """Write figures, tables, pictures and the page of all that ``store`` has evaluated.

    ``out`` gets ``index.html`` and, for each problem, a folder with ``curve.{png,svg,pdf}``,
    ``table.{md,csv,tex}``, ``evaluations.csv`` (the number behind each point), and for each method
    ``NAME.gif``, ``NAME-reconstruction.png``, ``NAME-prediction.png`` and ``NAME-latents.png``, as
    far as there is such a thing. An earlier report there is replaced; other files are left alone.
    Raises `SolarError` for a store without evaluations, `UsageError` for ``out``.
    """
    found = [problem for problem in problems(store) if problem.curves]
    if not found:
        raise SolarError(
            f"nothing to report in {store}: no cell has been evaluated; "
            "`solar run --task nav --method solar --seeds 1` is a start"
        )
    present = code()
    artifacts = {(artifact.cell, artifact.kind): artifact for artifact in store.artifacts()}
    memory = _memory(store)
    sections = [section(store, problem, present, artifacts, memory) for problem in found]
    records = store.cells()
    files: dict[str, bytes] = {}
    for name, part in zip(file_names(p.title for p in found), sections, strict=True):
        files |= {f"{name}/{file}": content for file, content in _files(part).items()}
    html = page(sections, cell_lines(records, present), origins(records), code_label(present))
    files["index.html"] = html.encode()
    paths = publish(out, files)
    lines = [
        text
        for part in sections
        for curve, summary in zip(part.problem.curves, part.summaries, strict=True)
        for text in (
            line(part.problem, summary),
            *(f"{part.problem.title} {curve.label}: {said}" for said in cut(curve)),
        )
    ]
    return Report(out / "index.html", tuple(paths), tuple(lines))


def _memory(store: Store) -> dict[str, float]:
    """Peak memory of each cell that measured it, in bytes."""
    peaks: dict[str, float] = {}
    for row in store.metrics(names=[MEMORY], splits=["train"]):
        peaks[row["cell"]] = max(row["value"], peaks.get(row["cell"], 0.0))
    return peaks


def _files(part: Section) -> dict[str, bytes]:
    """The folder of one problem."""
    files = {f"curve.{format}": content for format, content in part.curve_files.items()}
    files["table.md"] = part.results.to_markdown().encode()
    files["table.tex"] = part.results.to_latex().encode()
    files["table.csv"] = _csv([flat(part.problem, summary) for summary in part.summaries])
    files["evaluations.csv"] = _csv(_evaluations(part.problem))
    names = file_names(exhibit.label for exhibit in part.exhibits)
    for name, exhibit in zip(names, part.exhibits, strict=True):
        if exhibit.animation is not None:
            files[f"{name}.gif"] = exhibit.animation
        if exhibit.reconstruction is not None:
            files[f"{name}-reconstruction.png"] = exhibit.reconstruction
        if exhibit.prediction is not None:
            files[f"{name}-prediction.png"] = exhibit.prediction
        if exhibit.latents is not None:
            files[f"{name}-latents.png"] = exhibit.latents
    return files


def _evaluations(problem: Problem) -> list[dict[str, Any]]:
    """Every point of every thin line, with all digits."""
    return [
        {
            "cell": seed.record.hash,
            "method": curve.method,
            "variant": curve.variant,
            "seed": seed.seed,
            "episodes": episodes,
            problem.measure.headline: value,
        }
        for curve in problem.curves
        for seed in curve.seeds
        for episodes, value in zip(seed.episodes.tolist(), seed.values.tolist(), strict=True)
    ]


def _csv(rows: Sequence[Mapping[str, Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def file_names(titles: Iterable[str]) -> list[str]:
    """A file name for each title, safe on any system, and no two alike."""
    names: list[str] = []
    for title in titles:
        name = re.sub(r"[^a-z0-9_.-]+", "-", title).strip(".-")
        if not re.fullmatch(r"[a-z0-9_.:@-]+", title) or name in ("", *names):
            name += f"-{hashlib.sha256(title.encode()).hexdigest()[:8]}"
        names.append(name.lstrip("-"))
    return names
