"""Episodes: the one currency of all methods; running a policy for some, and evaluating it.

Axes: N episodes, T actions an episode, W frames an observation window, a entries of an action.
A learner sees frames, actions and costs. Ground truth (measures, true positions) is kept apart, in
`Evaluation` and in the summaries of a ledger, out of a learner's reach.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from solar_cli.envs.task import Frames, Task
from solar_cli.pulse import Diverged
from solar_cli.settings import TaskSettings
from solar_cli.streams import Streams

Floats = NDArray[np.float64]


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
    """Run one episode for each reset stream, as many side by side as the task allows.

    Raises `Diverged` where a state that a task shows is not finite.
    """
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
    _require_finite(first, np.ones(count, np.bool_), 0)
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
        _require_finite(frames[:, t + 1], lengths > t, t + 1)
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


def _require_finite(frames: Frames, live: NDArray[np.bool_], t: int) -> None:
    """Raise `Diverged` for states (N, S) at step ``t`` that no policy can act on.

    Images always are finite; what is shown after the end of an episode, not ``live``, is nobody's.
    """
    if frames.dtype.kind != "f" or np.isfinite(frames).all():
        return
    if len(odd := np.argwhere(~np.isfinite(frames) & live[:, None])):
        entry, value = odd[0, 1], frames[tuple(odd[0])]
        raise Diverged(f"entry {entry} of the observed state is {value} at step {t} of an episode")


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
