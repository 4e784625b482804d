"""What must be said beside a curve: the code it comes from, and the seeds that did not finish."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from solar_cli.experiment.matrix import is_stale
from solar_cli.experiment.provenance import code_name
from solar_cli.reporting.curves import Curve
from solar_cli.reporting.tables import number, ranges
from solar_cli.store.records import CellRecord, State
from solar_cli.store.store import Store
from solar_cli.wording import counted, plural


def codes(store: Store, curve: Curve) -> dict[str, list[int]]:
    """Names of the code that computed a curve, each with its seeds; of all attempts of a seed."""
    names: dict[str, list[int]] = {}
    for seed in curve.seeds:
        for name in sorted(
            {code_label(provenance) for provenance in _provenances(store, seed.record)}
        ):
            names.setdefault(name, []).append(seed.seed)
    return names


def _provenances(store: Store, record: CellRecord) -> list[dict[str, Any]]:
    last = record.last_attempt
    if last is None or last.number == 1:  # the usual case costs no query
        return [] if last is None else [last.provenance]
    return [attempt.provenance for attempt in store.attempts(record.hash)]


def code_label(provenance: Mapping[str, Any]) -> str:
    """`code_name`, with the first digits of the hash of what was not committed."""
    changes = provenance.get("diff_sha256")
    return code_name(provenance) + (f" {str(changes)[:6]}" if changes else "")


def notes(store: Store, curve: Curve, present: Mapping[str, Any]) -> list[str]:
    """One line for each thing that a reader of the curve has to know, the curve's label first.

    ``present`` is the code of now (`provenance.code`): finished seeds of other code are stale.
    """
    lines = _code_notes(store, curve, present)
    seeds = {seed.record.hash: seed for seed in curve.seeds}
    for record in curve.records:
        seed, name = seeds.get(record.hash), f"seed {record.cell.seed}"
        error = record.last_attempt.error if record.last_attempt else None
        cause = f": {error}" if error else ""
        reached = "" if seed is None else counted(int(seed.episodes[-1]), "episode")
        if seed is None:
            lines.append(f"{name} is {record.state.value} and has no value: it is left out{cause}")
        elif seed.diverged:
            lines.append(
                f"{name} diverged after {reached} and counts as "
                f"{number(seed.penalty)} from there on{cause}"
            )
        elif record.state is not State.FINISHED:
            lines.append(f"{name} is {record.state.value} at {reached}{cause}")
    return [f"{curve.label}: {line}" for line in [*lines, *cut(curve)]]


def cut(curve: Curve) -> list[str]:
    """What to know of a curve some seeds of which go on further: a line, or none."""
    longest = max(int(seed.episodes[-1]) for seed in curve.seeds)
    if longest <= curve.end:
        return []
    short = [seed.seed for seed in curve.seeds if seed.end == curve.end]
    return [
        f"ends at {curve.end} of {counted(longest, 'episode')}, where its shortest seed ends "
        f"({_named(short)})"
    ]


def _code_notes(store: Store, curve: Curve, present: Mapping[str, Any]) -> list[str]:
    names = codes(store, curve)
    lines = []
    if len(names) > 1:
        parts = [f"{name} ({_named(seeds)})" for name, seeds in names.items()]
        lines.append(f"seeds or attempts of different code in one curve: {'; '.join(parts)}")
    elif any(" with changes" in name for name in names):
        lines.append(f"computed with uncommitted changes: {next(iter(names))}")
    stale = [seed.seed for seed in curve.seeds if is_stale(seed.record, present)]
    if stale:
        lines.append(f"stale: {code_label(present)} did not compute {_named(stale)}")
    return lines


def _named(seeds: list[int]) -> str:
    """``seed 3`` or ``seeds 0-4, 7``."""
    return f"{plural('seed', len(seeds))} {ranges(seeds)}"
