"""Everything that a report says of one problem, and of the store, ready to be written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from solar_cli.errors import SolarError
from solar_cli.experiment.matrix import is_stale
from solar_cli.reporting import figures, health
from solar_cli.reporting.animation import animation, arrays, reconstructions
from solar_cli.reporting.compare import Comparison, baseline_of, compare_curves, stands_in
from solar_cli.reporting.curves import Curve, Problem, SeedCurve
from solar_cli.reporting.evidence import code_label
from solar_cli.reporting.latents import latent_space
from solar_cli.reporting.summary import Summary, duration, summarise, table
from solar_cli.reporting.tables import Table
from solar_cli.settings import TaskSettings
from solar_cli.store.records import ArtifactRecord, CellRecord, State
from solar_cli.store.store import Store
from solar_cli.wording import counted

MEMORY = "peak_memory_bytes"
"""Metric of the training split, where a worker measures it."""

PICTURES = ("animation", "reconstruction", "prediction", "latents")
"""Kinds of artifacts that are drawn."""

Artifacts = Mapping[tuple[str, str], ArtifactRecord]
"""(cell, kind) -> file"""


@dataclass(frozen=True)
class Exhibit:
    """Pictures of one curve, from one seed."""

    label: str
    seed: int
    animation: bytes | None
    reconstruction: bytes | None
    prediction: bytes | None
    latents: bytes | None
    damage: tuple[str, ...]
    """why a stored picture is not shown"""


@dataclass(frozen=True)
class Section:
    """One problem."""

    problem: Problem
    summaries: tuple[Summary, ...]
    results: Table
    comparison: Table | None
    """with the baseline, where there is one and another curve"""
    curve_files: dict[figures.FileFormat, bytes]
    dark_curve: bytes
    """SVG on a transparent ground"""
    exhibits: tuple[Exhibit, ...]
    health: health.Chart


def section(
    store: Store,
    problem: Problem,
    present: Mapping[str, Any],
    artifacts: Artifacts,
    memory: Mapping[str, float],
) -> Section:
    """All of one problem. ``present`` is the code of now, ``memory`` peaks in bytes by cell."""
    summaries = [summarise(store, curve, present, memory) for curve in problem.curves]
    figure = figures.learning_curve(problem)
    return Section(
        problem=problem,
        summaries=tuple(summaries),
        results=table(problem, summaries),
        comparison=_comparison(problem),
        curve_files={
            "png": figures.render(figure, "png"),
            "svg": figures.render(figure, "svg"),
            "pdf": figures.render(figure, "pdf"),
        },
        dark_curve=figures.render(figures.learning_curve(problem, figures.DARK), "svg"),
        exhibits=tuple(
            shown for curve in problem.curves if (shown := exhibit(curve, artifacts)) is not None
        ),
        health=health.chart(store, problem.curves),
    )


def _comparison(problem: Problem) -> Table | None:
    baseline = baseline_of(problem)
    others = [curve for curve in problem.curves if curve is not baseline]
    if baseline is None or not others:
        return None
    said = stands_in(baseline)
    pairs = tuple(compare_curves(problem, curve, baseline, said) for curve in others)
    return next(iter(Comparison(pairs).tables.values()))


def exhibit(curve: Curve, artifacts: Artifacts) -> Exhibit | None:
    """Pictures of the seed in the middle of the final values, never of the best one.

    Where a model sees a state, of the policy alone; None where there is nothing to show.
    """
    having = [
        seed
        for seed in _by_final_value(curve)
        if any((seed.record.hash, kind) in artifacts for kind in PICTURES)
    ]
    if not having:
        return None
    record = having[(len(having) - 1) // 2].record
    settings = record.cell.configuration.task
    of_model = settings.observation.kind == "image"
    damage: list[str] = []

    def drawn(kind: str) -> bytes | None:
        if kind != "animation" and not of_model:
            return None
        try:
            return _draw(settings, kind, artifacts.get((record.hash, kind)))
        except SolarError as error:
            damage.append(str(error))
            return None

    pictures = {kind: drawn(kind) for kind in PICTURES}
    if not damage and not any(pictures.values()):
        return None
    return Exhibit(curve.label, record.cell.seed, **pictures, damage=tuple(damage))


def _draw(settings: TaskSettings, kind: str, artifact: ArtifactRecord | None) -> bytes | None:
    if artifact is None:
        return None
    stored = arrays(artifact)
    try:
        if kind == "animation":
            frames = stored["frames"]
            # Of a task seen as a state, older versions stored states: (K, T+1, S).
            return animation(settings, frames) if frames.ndim == 5 else None
        if kind in ("reconstruction", "prediction"):
            return reconstructions(settings, stored["original"], stored[kind])
        space = latent_space(stored["latents"], stored["truth"], stored["names"].tolist())
        return None if space is None else figures.render(space, "png")
    except (KeyError, ValueError, IndexError) as error:
        raise SolarError(f"{kind} of {artifact.path.name} cannot be drawn: {error}") from error


def _by_final_value(curve: Curve) -> list[SeedCurve]:
    order = curve.final.argsort(kind="stable")
    return [curve.seeds[index] for index in order]


@dataclass(frozen=True)
class CellLine:
    """One cell in the list of all cells."""

    record: CellRecord
    stale: bool
    attempts: int
    error: str

    @property
    def state(self) -> str:
        """As in ``solar status``: a finished cell of other code is stale."""
        return "stale" if self.stale else self.record.state.value

    @property
    def time(self) -> str:
        """Of computing."""
        return duration(self.record.seconds)

    @property
    def code(self) -> str:
        """Name of the newest attempt's code."""
        last = self.record.last_attempt
        return code_label(last.provenance) if last else ""

    @property
    def failed(self) -> bool:
        """Whether a person must look at it."""
        return self.record.state in (State.FAILED, State.DIVERGED)


def cell_lines(records: list[CellRecord], present: Mapping[str, Any]) -> list[CellLine]:
    """All cells, in the store's order."""
    return [
        CellLine(
            record,
            is_stale(record, present),
            record.last_attempt.number if record.last_attempt else 0,
            (record.last_attempt.error if record.last_attempt else None) or "",
        )
        for record in records
    ]


def origins(records: list[CellRecord]) -> list[tuple[str, ...]]:
    """Where the numbers come from, one row a distinct origin: `ORIGIN_COLUMNS`.

    No host names and no folders: a report is made to be passed on.
    """
    found: dict[tuple[str, ...], int] = {}
    for record in records:
        if record.last_attempt is not None:
            row = _origin(record.last_attempt.provenance)
            found[row] = found.get(row, 0) + 1
    return [(str(count), *row) for row, count in found.items()]


ORIGIN_COLUMNS = ("cells", "code", "changes", "machine", "device", "versions", "command")


def _origin(provenance: Mapping[str, Any]) -> tuple[str, ...]:
    hardware = provenance.get("hardware") or {}
    memory = hardware.get("memory_bytes")
    machine = [
        hardware.get("processor"),
        counted(hardware["cores"], "core") if "cores" in hardware else None,
        f"{memory / 2**30:.0f} GiB" if memory else None,
        *hardware.get("gpus", []),
        hardware.get("system"),
    ]
    packages = dict(provenance.get("packages") or {})
    versions = [f"Python {provenance.get('python', '?')}"]
    versions += [f"{name} {version}" for name, version in packages.items()]
    # Folders of whoever ran it concern no reader, and may hold a name.
    words = [PurePath(word).name for word in str(provenance.get("command", "")).split(" ")]
    return (
        str(provenance.get("commit") or f"version {provenance.get('version', 'unknown')}"),
        f"yes, {str(provenance['diff_sha256'])[:12]}" if provenance.get("dirty") else "none",
        ", ".join(str(part) for part in machine if part),
        str(provenance.get("device", "")),
        ", ".join(versions),
        " ".join(words),
    )
