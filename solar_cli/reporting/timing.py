"""Where the wall-clock time of cells went, from what every iteration stored of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from solar_cli.store.records import CellRecord
from solar_cli.store.store import Store

ACTIVITIES = {
    "seconds_training": "training networks",
    "seconds_discarded": "trainings that were discarded",
    "seconds_judging": "encoding collected episodes and judging the model",
    "seconds_collecting": "collecting episodes",
    "seconds_control": "all else that the method does",
    "seconds_evaluating": "evaluating",
    "seconds_saving": "saving",
}
"""metric of the training split -> what it measures"""
OTHER = "starting, pictures, what was not measured"


@dataclass(frozen=True)
class Share:
    """What one activity took."""

    activity: str
    seconds: float
    """summed over iterations and cells"""
    share: float
    """of all computing"""


def shares(store: Store, records: Sequence[CellRecord]) -> list[Share]:
    """What each activity took of the cells' computing; nothing where none was measured."""
    total = sum(record.seconds for record in records)
    found: dict[str, float] = {}
    hashes = [record.hash for record in records]
    for row in store.metrics(hashes=hashes, names=list(ACTIVITIES), splits=["train"]):
        found[row["name"]] = found.get(row["name"], 0.0) + row["value"]
    if not found or total <= 0:
        return []
    known = [(said, found[name]) for name, said in ACTIVITIES.items() if name in found]
    known.append((OTHER, max(0.0, total - sum(found.values()))))
    return [Share(activity, seconds, seconds / total) for activity, seconds in known]


def note(label: str, found: Sequence[Share]) -> list[str]:
    """One line for a report, the largest share first; none where nothing was measured."""
    told = sorted(found, key=lambda share: -share.share)
    parts = [f"{share.share:.0%} {share.activity}" for share in told if share.share >= 0.005]
    return [f"{label}: its computing was {', '.join(parts)}"] if parts else []
