"""Episodes: the one currency of all methods; collecting, keeping and evaluating them.

Axes: N episodes, T actions an episode, W frames an observation window, a entries of an action.
A learner sees frames, actions and costs. Ground truth (measures, true positions) is kept apart, in
`Evaluation` and in the ledger's summaries, out of a learner's reach.
"""

from __future__ import annotations

import hashlib
import io
import os
import warnings
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from solar_cli.envs.task import Task
from solar_cli.errors import LostFiles
from solar_cli.settings import TaskSettings
from solar_cli.streams import Streams

Floats = NDArray[np.float64]
HELD = 8
"""batches of frames held in memory: more than a local method at its defaults asks for in a turn"""

ARRAYS = ("frames", "actions", "action_means", "costs")
"""what every file of episodes holds, by the names of `Episodes`"""


class Policy(Protocol):
    """What acts. Noise is drawn when an episode starts, so that it may be smooth over time."""

    def start(self, episodes: int, stream: np.random.Generator | None) -> Any:
        """The state that ``act`` carries; without a stream the policy is noise-free.

        Episodes may come in groups, each with a call of its own and all with one stream: what is
        drawn is drawn episode by episode.
        """

    def act(self, observations: NDArray[Any], t: int, state: Any) -> tuple[Floats, Floats, Any]:
        """Actions (N, a) for windows (N, W, *frame) at step ``t``, their means, the state."""


class Batch(NamedTuple):
    """Names the episodes of one call of `Environment.collect`."""

    iteration: int
    call: int
    """the first of an iteration is 0"""
    noisy: bool = True
    """whether the policy had its noise"""


@dataclass(frozen=True)
class Episodes:
    """Trajectories as batched arrays; each frame is held once, windows are index views."""

    frames: NDArray[Any]
    """(N, T+1, C, H, W) uint8 or (N, T+1, S) float32"""
    actions: Floats
    """(N, T, a) as executed, after clipping"""
    action_means: Floats
    """(N, T, a) what the policy would have done without noise"""
    costs: Floats
    """(N, T) of the state and the executed action of each step"""
    window: int = 1
    """frames an observation holds"""
    lengths: NDArray[np.int64] = None  # type: ignore[assignment]
    """(N,) live steps of each episode; T, the default, where nothing ended early"""
    batch: Batch | None = None
    """the call that collected them, all of them; None for any others"""

    def __post_init__(self) -> None:
        if self.lengths is None:
            object.__setattr__(self, "lengths", np.full(len(self.frames), self.horizon))

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def horizon(self) -> int:
        """T: actions an episode has."""
        return int(self.actions.shape[1])

    @property
    def live_steps(self) -> NDArray[np.bool_]:
        """(N, T) whether an episode was still running: nothing may be learned from other steps."""
        return np.asarray(np.arange(self.horizon) < self.lengths[:, None])

    @property
    def live_frames(self) -> NDArray[np.bool_]:
        """(N, T+1) the frames that live steps start from and lead to."""
        return np.asarray(np.arange(self.horizon + 1) <= self.lengths[:, None])

    def __getitem__(self, rows: Any) -> Episodes:
        return Episodes(
            self.frames[rows],
            self.actions[rows],
            self.action_means[rows],
            self.costs[rows],
            self.window,
            self.lengths[rows],
        )

    @staticmethod
    def joined(parts: Sequence[Episodes]) -> Episodes:
        """All episodes of several batches, in order."""
        if len(parts) == 1:
            return parts[0]
        return Episodes(
            np.concatenate([part.frames for part in parts]),
            np.concatenate([part.actions for part in parts]),
            np.concatenate([part.action_means for part in parts]),
            np.concatenate([part.costs for part in parts]),
            parts[0].window,
            np.concatenate([part.lengths for part in parts]),
        )


@dataclass(frozen=True)
class Evaluation:
    """Episodes with the ground truth that only a judge may see."""

    episodes: Episodes
    measures: Mapping[str, Floats]
    """name -> (N, T+1)"""
    truth: Floats
    """(N, T+1, k) true positions, to diagnose latents with"""
    truth_names: tuple[str, ...] = ()

    @staticmethod
    def joined(parts: Sequence[Evaluation]) -> Evaluation:
        """All episodes of several groups; ground truth that one of them lacks is missing in all."""
        if len(parts) == 1:
            return parts[0]
        names = set.intersection(*(set(part.measures) for part in parts))
        whole = all(part.truth_names for part in parts)
        return Evaluation(
            Episodes.joined([part.episodes for part in parts]),
            {
                name: np.concatenate([part.measures[name] for part in parts])
                for name in sorted(names)
            },
            np.concatenate([part.truth if whole else part.truth[..., :0] for part in parts]),
            parts[0].truth_names if whole else (),
        )

    def summary(self) -> dict[str, Floats]:
        """One number an episode: return, and each measure's final and mean value."""
        summary = {"return": -self.episodes.costs.sum(axis=1)}
        for name, values in self.measures.items():
            summary[f"final_{name}"] = values[:, -1]
            summary[f"mean_{name}"] = values.mean(axis=1)
        return summary


def window_indices(horizon: int, window: int) -> NDArray[np.int64]:
    """(T+1, W) frame numbers of every observation; before the start the first frame repeats."""
    steps = np.arange(horizon + 1)[:, None] + np.arange(1 - window, 1)[None, :]
    return np.asarray(np.maximum(steps, 0), np.int64)


def roll_out(
    task: Task,
    settings: TaskSettings,
    policy: Policy,
    resets: Sequence[np.random.Generator],
    noise: np.random.Generator | None,
) -> Evaluation:
    """Run one episode for each reset stream, as many side by side as the task allows."""
    size = task.at_once or len(resets)
    groups = [resets[i : i + size] for i in range(0, len(resets), size)]
    return Evaluation.joined([_run(task, settings, policy, group, noise) for group in groups])


def _run(
    task: Task,
    settings: TaskSettings,
    policy: Policy,
    resets: Sequence[np.random.Generator],
    noise: np.random.Generator | None,
) -> Evaluation:
    """Run one episode for each reset stream, all at once.

    In the steps after an episode's end no action is executed; they cost what the task says.
    """
    count, horizon, window = len(resets), settings.horizon, settings.observation.window
    index = window_indices(horizon, window)
    first = task.reset(resets)
    frames = np.empty((count, horizon + 1, *first.shape[1:]), first.dtype)
    frames[:, 0] = first
    actions = np.empty((count, horizon, settings.action.size))
    means = np.empty_like(actions)
    costs = np.empty((count, horizon))
    lengths = np.full(count, horizon)
    measures, truths = [_ground_truth(task)[0]], [_ground_truth(task)[1]]
    state = policy.start(count, noise)
    for t in range(horizon):
        wanted, means[:, t], state = policy.act(frames[:, index[t]], t, state)
        actions[:, t] = np.clip(wanted, -settings.action.bound, settings.action.bound)
        frames[:, t + 1], costs[:, t] = task.step(actions[:, t])
        actions[lengths <= t, t] = means[lengths <= t, t] = 0.0
        lengths[task.ended() & (lengths > t)] = t + 1
        measured, truth = _ground_truth(task)
        measures.append(measured)
        truths.append(truth)
    names = set(measures[0]).intersection(*measures)
    return Evaluation(
        Episodes(frames, actions, means, costs, window, lengths),
        {name: np.stack([step[name] for step in measures], axis=1) for name in sorted(names)},
        *_stacked(truths, count, task.truth_names),
    )


def _stacked(
    truths: list[Floats], episodes: int, names: tuple[str, ...]
) -> tuple[Floats, tuple[str, ...]]:
    """Positions of all steps, or none where one is missing."""
    if any(truth.shape != (episodes, len(names)) for truth in truths):
        return np.empty((episodes, len(truths), 0)), ()
    return np.stack(truths, axis=1), names


def _ground_truth(task: Task) -> tuple[dict[str, Floats], Floats]:
    """Measures and true positions, or none: a judge that fails must not stop a learner."""
    try:
        return dict(task.measures()), task.truth()
    except Exception as error:
        warnings.warn(f"ground truth is missing: {type(error).__name__}: {error}", stacklevel=2)
        return {}, np.empty((0, 0))


def evaluate(
    task: Task, settings: TaskSettings, policy: Policy, episodes: int, streams: Streams
) -> Evaluation:
    """Fresh episodes of the noise-free policy, on their own streams."""
    return roll_out(
        task, settings, policy, [streams.generator("reset", i) for i in range(episodes)], None
    )


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
