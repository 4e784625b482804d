"""What computing a cell brings: metrics, checkpoints, artifacts."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from sqlalchemy import and_, delete, insert, or_, select

from solar_cli.store import rows
from solar_cli.store.cells import chosen
from solar_cli.store.opened import Opened
from solar_cli.store.records import ArtifactRecord, CheckpointRecord, Metric
from solar_cli.store.schema import ArtifactRow, CellRow, CheckpointRow, MetricRow

CHECKPOINTS, EPISODES = "checkpoints", "episodes"
"""folders of a cell's files, below its own"""


class Results(Opened):
    """What the newest attempt writes and reports read."""

    def commit(
        self,
        hash: str,
        attempt: int,
        *,
        iteration: int,
        episodes: int,
        steps: int,
        simulated_seconds: float,
        seconds: float,
        metrics: Sequence[Metric] = (),
        checkpoint: CheckpointRecord | None = None,
    ) -> None:
        """Store that a cell has got to ``iteration``, its metrics and where to continue from.

        ``episodes``, ``steps``, ``simulated_seconds`` and ``seconds`` are totals of the cell.
        A commit inside an iteration (of a checkpoint that is not complete) brings no metrics.
        What an earlier attempt stored of this place or later ones goes. Raises `Fenced`.
        """
        _check_commit(iteration, metrics, checkpoint)
        totals = {
            "episodes": episodes,
            "steps": steps,
            "simulated_seconds": simulated_seconds,
            "seconds": seconds,
        }
        place = {"cell": hash, "iteration": iteration, "attempt": attempt}
        with self._database.writing() as session:
            cell, _ = self._writable(session, hash, attempt)
            session.execute(
                delete(MetricRow).where(MetricRow.cell == hash, MetricRow.iteration >= iteration)
            )
            measured = [{**place, **totals, **rows.metric_columns(metric)} for metric in metrics]
            if measured:
                session.execute(insert(MetricRow), measured)
            later = CheckpointRow.iteration > iteration
            if checkpoint is not None:
                here = CheckpointRow.iteration == iteration
                later = or_(later, and_(here, CheckpointRow.position >= checkpoint.position))
            session.execute(delete(CheckpointRow).where(CheckpointRow.cell == hash, later))
            if checkpoint is not None:
                now = self._database.now(session)
                session.add(rows.checkpoint_row(hash, attempt, checkpoint, now))
            cell.iteration = iteration
            for name, total in totals.items():
                setattr(cell, name, total)

    def checkpoints(self, hash: str) -> list[CheckpointRecord]:
        """What a cell can continue from, newest first."""
        with self._database.reading() as session:
            found = session.scalars(
                select(CheckpointRow)
                .where(CheckpointRow.cell == hash)
                .order_by(CheckpointRow.iteration.desc(), CheckpointRow.position.desc())
            )
            return [rows.checkpoint_record(row) for row in found]

    def forget_checkpoints(self, hash: str, attempt: int, keep: Collection[str]) -> None:
        """Delete the checkpoints whose paths are not in ``keep``, rows first, then files.

        Files in the cell's folder of checkpoints that no row names go too: a writer that was
        killed between writing and committing left them. Raises `Fenced`.
        """
        folder = self.folder(hash)
        with self._database.writing() as session:
            self._writable(session, hash, attempt)
            named = select(CheckpointRow.path).where(CheckpointRow.cell == hash)
            old = set(session.scalars(named)) - set(keep)
            session.execute(
                delete(CheckpointRow).where(CheckpointRow.cell == hash, CheckpointRow.path.in_(old))
            )
            kept = {folder / path for path in session.scalars(named)}
        for path in {*(folder / path for path in old), *(folder / CHECKPOINTS).glob("*")} - kept:
            path.unlink(missing_ok=True)

    def metrics(
        self,
        *,
        tasks: Collection[str] = (),
        methods: Collection[str] = (),
        variants: Collection[str] = (),
        seeds: Collection[int] = (),
        hashes: Collection[str] = (),
        names: Collection[str] = (),
        splits: Collection[str] = (),
        values: bool = False,
    ) -> list[dict[str, Any]]:
        """One plain row a metric, sorted; an empty collection leaves that open.

        Keys: cell (hash), task, method, variant, seed, iteration, episodes, steps,
        simulated_seconds, seconds, split, name, value (float, as it was measured), kind (finite,
        nan, +inf, -inf) and, with ``values``, values (float64, one an episode, or ``None``).
        """
        columns = [*METRIC_COLUMNS, MetricRow.episode_values.label("values")]
        wanted = chosen(tasks, methods, variants, seeds, hashes)
        if names:
            wanted.append(MetricRow.name.in_(names))
        if splits:
            wanted.append(MetricRow.split.in_(splits))
        order = [CellRow.task, CellRow.method, CellRow.variant, CellRow.seed, MetricRow.cell]
        order += [MetricRow.iteration, MetricRow.split, MetricRow.name]
        with self._database.reading() as session:
            found = session.execute(
                select(*(columns if values else METRIC_COLUMNS))
                .join(CellRow, CellRow.hash == MetricRow.cell)
                .where(*wanted)
                .order_by(*order)
            ).mappings()
            measured = [dict(row) for row in found]
        for row in measured:
            row["value"] = rows.number(row["value"], row["kind"])
            if values:
                row["values"] = rows.array(row["values"])
        return measured

    def add_artifact(self, hash: str, attempt: int, kind: str, path: Path, iteration: int) -> None:
        """Store a file for the report, which lies complete in the cell's folder.

        It replaces the one of the same kind, whose file goes. Raises `Fenced`.
        """
        folder = self.folder(hash)
        name = path.resolve().relative_to(folder.resolve()).as_posix()
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        with self._database.writing() as session:
            _, row = self._writable(session, hash, attempt)
            old = session.get(ArtifactRow, (hash, kind))
            replaced = None if old is None else old.path
            session.merge(
                ArtifactRow(
                    cell=hash,
                    kind=kind,
                    iteration=iteration,
                    attempt=attempt,
                    path=name,
                    sha256=sha256,
                    bytes=path.stat().st_size,
                    created=row.heartbeat,
                )
            )
        if replaced is not None and replaced != name:
            (folder / replaced).unlink(missing_ok=True)

    def artifacts(self, hash: str | None = None, kind: str | None = None) -> list[ArtifactRecord]:
        """Files for the report, of one cell or all, of one kind or all; sorted by both."""
        wanted = []
        if hash is not None:
            wanted.append(ArtifactRow.cell == hash)
        if kind is not None:
            wanted.append(ArtifactRow.kind == kind)
        with self._database.reading() as session:
            found = session.scalars(
                select(ArtifactRow).where(*wanted).order_by(ArtifactRow.cell, ArtifactRow.kind)
            )
            return [
                ArtifactRecord(
                    cell=row.cell,
                    kind=row.kind,
                    path=self.folder(row.cell) / row.path,
                    sha256=row.sha256,
                    bytes=row.bytes,
                    iteration=row.iteration,
                )
                for row in found
            ]


METRIC_COLUMNS = (
    MetricRow.cell,
    CellRow.task,
    CellRow.method,
    CellRow.variant,
    CellRow.seed,
    MetricRow.iteration,
    MetricRow.episodes,
    MetricRow.steps,
    MetricRow.simulated_seconds,
    MetricRow.seconds,
    MetricRow.split,
    MetricRow.name,
    MetricRow.value,
    MetricRow.kind,
)


def _check_commit(
    iteration: int, metrics: Sequence[Metric], checkpoint: CheckpointRecord | None
) -> None:
    """Refuse what no worker means, before anything is replaced by it."""
    names = [(metric.split, metric.name) for metric in metrics]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"metric {twice} is given twice")
    if checkpoint is None:
        return
    if checkpoint.iteration != iteration:
        raise ValueError(f"checkpoint of iteration {checkpoint.iteration} in one of {iteration}")
    if metrics and not checkpoint.complete:
        raise ValueError("metrics belong to the end of an iteration, not to a checkpoint inside it")
    path = PurePosixPath(checkpoint.path)
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"checkpoint path {checkpoint.path!r} leaves the cell's folder")
