"""What a cell has collected: a ledger of episodes, their immutable files, and a learner's view.

Collected episodes count; a file holds each batch that may be wanted again, and its hash says that
it is whole.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from solar_cli.envs.task import Task
from solar_cli.episodes import Batch, Episodes, Evaluation, Policy, roll_out
from solar_cli.errors import LostFiles
from solar_cli.settings import TaskSettings
from solar_cli.streams import Streams

HELD = 8
"""batches of frames held in memory: more than a local method at its defaults asks for in a turn"""

ARRAYS = ("frames", "actions", "action_means", "costs")
"""what every file of episodes holds, by the names of `Episodes`"""


class Environment:
    """The world that a cell learns in: it collects, and what it collects counts.

    Collections are keyed by (iteration, call): repeating an iteration after an interruption finds
    its episodes on disk, or, when a file is damaged, collects the very same ones again. So it does
    with those that nobody wanted kept.
    """

    def __init__(self, task: Task, settings: TaskSettings, streams: Streams, folder: Path) -> None:
        self.settings = settings
        self.iteration = 0
        self._task = task
        self._streams = streams
        self._folder = folder
        self._ledger: list[dict[str, Any]] = []
        self._held: OrderedDict[tuple[int, int], Episodes] = OrderedDict()  # last asked for last
        self._call = 0

    @property
    def episodes(self) -> int:
        """Episodes collected so far: the x-axis of every curve."""
        return sum(int(entry["episodes"]) for entry in self._ledger)

    @property
    def steps(self) -> int:
        """Actions executed so far."""
        return sum(int(entry["steps"]) for entry in self._ledger)

    def begin(self, iteration: int) -> None:
        """Start, or start again, an iteration."""
        self.iteration = iteration
        self._call = 0

    def resume_at(self, call: int) -> None:
        """Go on with this call of the iteration: the earlier ones are learned from already."""
        self._call = call

    def collect(
        self, policy: Policy, episodes: int, *, noisy: bool = True, kept: bool = True
    ) -> Episodes:
        """Line 4 of Algorithm 1: run the policy for ``episodes`` episodes that count.

        Those that are not ``kept`` are on no disk, and no `batches` name them: a method on policy
        learns from them once.
        """
        key = (self.iteration, self._call)
        self._call += 1
        entry = next((e for e in self._ledger if (e["iteration"], e["call"]) == key), None)
        if entry is not None and (entry["noisy"], entry["episodes"]) != (noisy, episodes):
            raise LostFiles(  # of a version that collected in another order, say
                f"iteration {key[0]} has {entry['episodes']} episodes where {episodes} others are "
                "collected now: start the cell anew with --redo"
            )
        found = self._load(entry) if kept and entry is not None else None
        if found is None:
            streams = self._streams.under(*key)
            collected = roll_out(
                self._task,
                self.settings,
                policy,
                [streams.generator("reset", i) for i in range(episodes)],
                streams.generator("noise") if noisy else None,
            )
            if not kept:
                if entry is None:
                    self._ledger.append(self._described(key, noisy, collected))
                return collected.episodes
            found = replace(collected.episodes, batch=Batch(*key, noisy))
            data = _packed(found)
            made = self._described(key, noisy, collected) | _named(key, data)
            # Compared as files: one that another zlib has compressed counts as another, too.
            if entry is not None and made["sha256"] != entry["sha256"]:
                # The policy is not the one that collected them: a training has gone on since.
                raise self._lost(entry)
            self._store(made["file"], data)
            if entry is None:
                self._ledger.append(made)
        return self._hold(key, found)

    def batches(self) -> list[Batch]:
        """All that was collected and kept, oldest first."""
        return [_name(entry) for entry in self._kept()]

    def batch(self, name: Batch) -> Episodes:
        """The episodes of one call."""
        return self._get(next(entry for entry in self._kept() if _name(entry) == name))

    def recent(self, iterations: int) -> list[Episodes]:
        """The batches of the last ``iterations``, in their order."""
        first = self.iteration - iterations + 1
        named = [name for name in self.batches() if first <= name.iteration <= self.iteration]
        return [self.batch(name) for name in named]

    def summary(self, iteration: int) -> dict[str, float]:
        """Means over the noisy episodes of an iteration: return, final measures, clipped share."""
        entries = [e for e in self._ledger if e["iteration"] == iteration and e["noisy"]]
        weights = [entry["episodes"] for entry in entries]
        names = set.intersection(*(set(e["summary"]) for e in entries)) if entries else set()
        return {
            name: float(np.average([e["summary"][name] for e in entries], weights=weights))
            for name in sorted(names)
        }

    def state_dict(self) -> dict[str, Any]:
        """The ledger: what was collected, and which files hold it, with their hashes."""
        return {"ledger": [dict(entry) for entry in self._ledger]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take up a ledger; the episodes are read when they are asked for."""
        self._ledger = [
            {"steps": entry["episodes"] * self.settings.horizon, **entry}  # older ones lack it
            for entry in state["ledger"]
        ]
        self._held.clear()

    def _kept(self) -> list[dict[str, Any]]:
        return [entry for entry in self._ledger if "file" in entry]

    def _get(self, entry: Mapping[str, Any]) -> Episodes:
        key = (int(entry["iteration"]), int(entry["call"]))
        found = self._held[key] if key in self._held else self._load(entry)
        if found is None:
            raise self._lost(entry)
        return self._hold(key, found)

    def _hold(self, key: tuple[int, int], episodes: Episodes) -> Episodes:
        """Keep episodes in memory until others have been asked for since."""
        self._held[key] = episodes
        self._held.move_to_end(key)
        if len(self._held) > HELD:
            self._held.popitem(last=False)
        return episodes

    def _lost(self, entry: Mapping[str, Any]) -> LostFiles:
        return LostFiles(
            f"episodes {self._folder / entry['file']} are missing or damaged: restore the file, or "
            "start the cell anew with --redo"
        )

    def _load(self, entry: Mapping[str, Any]) -> Episodes | None:
        try:
            data = (self._folder / entry["file"]).read_bytes()
        except OSError:
            return None
        if hashlib.sha256(data).hexdigest() != entry["sha256"]:
            return None
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            window = self.settings.observation.window
            return Episodes(**dict(arrays), window=window, batch=_name(entry))

    def _described(
        self, key: tuple[int, int], noisy: bool, collected: Evaluation
    ) -> dict[str, Any]:
        """The ledger's entry of episodes, but for their file."""
        episodes = collected.episodes
        clipped = np.abs(episodes.actions[episodes.live_steps]) >= self.settings.action.bound
        return {
            "iteration": key[0],
            "call": key[1],
            "noisy": noisy,
            "episodes": len(episodes),
            "steps": int(episodes.lengths.sum()),
            "summary": {
                **{name: float(values.mean()) for name, values in collected.summary().items()},
                "clipped": float(clipped.mean()),
            },
        }

    def _store(self, name: str, data: bytes) -> None:
        """Write the file whole or not at all."""
        self._folder.mkdir(parents=True, exist_ok=True)
        beside = self._folder / f".{name}.{os.getpid()}"
        with beside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(self._folder / name)


def _name(entry: Mapping[str, Any]) -> Batch:
    return Batch(int(entry["iteration"]), int(entry["call"]), bool(entry["noisy"]))


def _named(key: tuple[int, int], data: bytes) -> dict[str, Any]:
    """The part of the ledger's entry that is of a file."""
    name = f"{key[0]:04d}-{key[1]}.npz"
    return {"file": name, "sha256": hashlib.sha256(data).hexdigest()}


def _packed(episodes: Episodes) -> bytes:
    """What the file of these episodes holds; equal episodes give equal bytes."""
    arrays = {name: getattr(episodes, name) for name in ARRAYS}
    if not episodes.live_steps.all():  # a file of whole episodes keeps the bits that it always had
        arrays["lengths"] = episodes.lengths
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


class Experience:
    """An `Environment` as a learner meets it: episodes, and nothing that only a judge may see."""

    def __init__(self, environment: Environment) -> None:
        self.collect = environment.collect
        self.resume_at = environment.resume_at
        self.batches = environment.batches
        self.batch = environment.batch
        self.recent = environment.recent
        self.iteration = environment.iteration
