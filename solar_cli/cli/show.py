"""``solar show``: all about one cell."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from solar_cli.cli.options import AsJson, Database
from solar_cli.cli.printing import complain, duration, print_json, print_table, say
from solar_cli.wording import counted

if TYPE_CHECKING:
    from solar_cli.cli.configuration import Line
    from solar_cli.reporting.timing import Share
    from solar_cli.store.records import AttemptRecord, CellRecord

LOG_LINES = 15


def command(
    cell: Annotated[str, typer.Argument(help="The cell: the first digits of its hash.")],
    json: AsJson = False,
    db: Database = None,
) -> None:
    """Show one cell: its curve, what its configuration changes, its attempts, the end of its log.

    \b
    Example:
      solar show 3f2a
    """
    from solar_cli.reporting.signs import signs
    from solar_cli.reporting.timing import shares
    from solar_cli.store.store import Store

    with Store.open(db, read_only=True) as store:
        record = store.find(cell)
        headline = record.cell.configuration.evaluation.headline
        curve = store.metrics(hashes=[record.hash], names=[headline], splits=["noise_free"])
        bad = signs(store, record.hash)
        attempts = store.attempts(record.hash)
        times = shares(store, [record])
        folder = store.folder(record.hash)
    changed = _changed(record)
    log = _end_of(folder / "log.txt")
    if json:
        print_json(
            {
                "cell": record.hash,
                "title": record.cell.title,
                "state": record.state.value,
                "iteration": record.iteration,
                "episodes": record.episodes,
                "seconds": record.seconds,
                "folder": str(folder),
                "headline": headline,
                "curve": [[row["episodes"], row["value"]] for row in curve],
                "needs_a_look": bad,
                "configuration": record.cell.config(),
                "time": [asdict(share) for share in times],
                "changed": [asdict(line) for line in changed],
                "attempts": [_plain(attempt) for attempt in attempts],
                "log": log,
            }
        )
        return
    _print(record, folder, headline, curve)
    for line in bad:
        say(f"needs a look: {line}")
    _print_times(times)
    _print_changed(changed)
    _print_attempts(attempts)
    say(f"End of {folder / 'log.txt'}:" if log else "No log yet.")
    for line in log:
        say(f"  {line}")


def _changed(record: CellRecord) -> list[Line]:
    """What differs from the defaults; nothing where the card cannot be read any more."""
    from solar_cli.cli.configuration import changed_lines
    from solar_cli.errors import UsageError

    try:
        return changed_lines(record.cell)
    except UsageError as error:
        complain(f"solar: what this configuration changes is not shown: {error}")
        return []


def _end_of(path: Path) -> list[str]:
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    return text.splitlines()[-LOG_LINES:]


def _print(record: CellRecord, folder: Path, headline: str, curve: list[dict[str, Any]]) -> None:
    from solar_cli.cli.curve import plot

    code = f"{record.commit[:7]}{' with changes' if record.dirty else ''}" if record.commit else "?"
    say(f"{record.cell.title}  ({record.hash})")
    say(
        f"{record.state.value}: iteration {record.iteration}, {counted(record.episodes, 'episode')}"
        + ("" if record.target is None else f" of {record.target}")
        + f", {duration(record.seconds)} of computing, commit {code}"
    )
    say(f"files: {folder}")
    say()
    if not curve:
        say("No evaluation yet.")
        return
    evaluation = record.cell.configuration.evaluation
    unit = f" in {evaluation.unit}" if evaluation.unit else ""
    good = f"{evaluation.better} is better"
    say(f"{headline}{unit}, {counted(evaluation.episodes, 'noise-free episode')} ({good})")
    points = [row["episodes"] for row in curve], [row["value"] for row in curve]
    for line in plot(*points, encoding=sys.stdout.encoding or "utf-8"):
        say(line)
    say()


def _print_times(times: list[Share]) -> None:
    rows = [(time.activity, duration(time.seconds), f"{time.share:.1%}") for time in times]
    if rows:
        print_table(("activity", "time>", "share>"), rows, "Where the time went")


def _print_changed(changed: list[Line]) -> None:
    from solar_cli.cli.configuration import shown

    rows = [(line.path, shown(line.value), line.origin) for line in changed]
    if rows:
        print_table(("setting", "value", "from"), rows, "Different from the method's defaults")


def _print_attempts(attempts: list[AttemptRecord]) -> None:
    from solar_cli.store.records import Outcome

    rows = [
        (
            attempt.number,
            f"{attempt.started:%Y-%m-%d %H:%M:%S}",
            "" if attempt.ended is None else f"{attempt.ended:%Y-%m-%d %H:%M:%S}",
            attempt.outcome.value if attempt.outcome else "not ended",
            f"{attempt.owner.host}/{attempt.owner.pid}",
            attempt.target,
            attempt.error or ("" if attempt.outcome is Outcome.FINISHED else attempt.activity),
        )
        for attempt in attempts
    ]
    columns = ("number>", "started", "ended", "outcome", "host/process", "target>", "last word")
    print_table(columns, rows, "Attempts")


def _plain(attempt: AttemptRecord) -> dict[str, Any]:
    return {
        "number": attempt.number,
        "started": attempt.started.isoformat(),
        "ended": None if attempt.ended is None else attempt.ended.isoformat(),
        "outcome": attempt.outcome.value if attempt.outcome else None,
        "host": attempt.owner.host,
        "pid": attempt.owner.pid,
        "target": attempt.target,
        "activity": attempt.activity,
        "error": attempt.error,
        "provenance": attempt.provenance,
    }
