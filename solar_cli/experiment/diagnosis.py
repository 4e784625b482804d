"""Which part of a local method fails: the same seed again, each time with one part known.

Every run is made in memory and in a folder that is deleted: a privileged run is no result, and the
store is not touched (rules of evidence).
"""

from __future__ import annotations

import math
import tempfile
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from solar_cli.envs import Task, build_task
from solar_cli.episodes import evaluate
from solar_cli.errors import UsageError
from solar_cli.experience import Environment, Experience
from solar_cli.experiment.privileged import Part, World, of_positions, privileged, seen_whole
from solar_cli.methods import Diverged
from solar_cli.methods.local import LocalLearner
from solar_cli.settings import Cell, load, method, method_names
from solar_cli.settings.local import LocalControl
from solar_cli.streams import Streams

AS_IT_IS, ALL = "as it is", "all of these"


@dataclass(frozen=True)
class Finding:
    """How far the method gets with some parts known."""

    replaced: str
    """`AS_IT_IS`, a `Part`, or `ALL`"""
    level: float
    """the card's headline measure of the final policy; nan where the run diverged"""
    better_by: float
    """than as it is, in the measure's good direction"""
    episodes: int
    """that counted"""
    seconds: float
    notes: tuple[str, ...] = ()
    """what a reader has to know of the run"""


def local_learner(name: str) -> type[LocalLearner]:
    """The learner of that method. Raises `UsageError` for one that is not local."""
    learner = load(method(name).learner)
    if _is_local(learner):
        return cast(type[LocalLearner], learner)
    known = [other for other in method_names() if _is_local(load(method(other).learner))]
    raise UsageError(
        f"method {name!r} is not local: it has no representation, dynamics and cost to replace; "
        f"choose {' or '.join(known)}"
    )


def _is_local(learner: Any) -> bool:
    return isinstance(learner, type) and issubclass(learner, LocalLearner)


def parts(cell: Cell) -> list[Part]:
    """What can be replaced; the state cannot where a task tells no true positions."""
    known = bool(build_task(cell.configuration.task).truth_names)
    return [part for part in Part if known or part is not Part.STATE]


def diagnose(cell: Cell, episodes: int, device: str) -> Iterator[Finding]:
    """The cell as it is, with each of `parts` replaced, and with all, one after another.

    Each run ends with the iteration that reaches ``episodes``, and is judged as the cell would be.
    """
    possible = parts(cell)
    runs = {AS_IT_IS: frozenset[Part](), **{part.value: frozenset({part}) for part in possible}}
    better, base = cell.configuration.evaluation.better, math.nan
    for replaced, given in {**runs, ALL: frozenset(possible)}.items():
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            level, collected, notes = _run(cell, given, episodes, device, Path(folder))
        base = level if replaced == AS_IT_IS else base
        gain = level - base if better == "higher" else base - level
        yield Finding(replaced, level, gain, collected, time.monotonic() - began, notes)


def _run(
    cell: Cell, given: frozenset[Part], episodes: int, device: str, folder: Path
) -> tuple[float, int, tuple[str, ...]]:
    """Level, episodes collected and notes of the cell with some parts known."""
    task, configured = cell.configuration.task, cell.configuration.method
    assert isinstance(configured, LocalControl)
    # As in a worker: one simulator to learn in, another one to judge in.
    simulator: Task = build_task(task)
    other: Task = build_task(task)
    if Part.STATE in given:
        task, configured = of_positions(task, configured, len(other.truth_names))
        simulator, other = seen_whole(simulator), seen_whole(other)
    streams = Streams(cell.seed)
    environment = Environment(simulator, task, streams.under("environment"), folder)
    world = World(other, task, streams.under("observer"))
    learner = privileged(local_learner(cell.method), given, world)(
        configured, task, streams.under("learner"), device, lambda activity, fraction: None
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cause = _learn(learner, environment, episodes)
    notes = [cause] if cause else [str(warning.message) for warning in caught]
    level = math.nan
    if cause is None:
        judge, asked = (
            streams.under("evaluation", environment.iteration),
            cell.configuration.evaluation,
        )
        judged = evaluate(other, task, learner.policy, asked.episodes, judge)
        level = float(judged.summary()[asked.headline].mean())
    return level, environment.episodes, tuple(dict.fromkeys(notes))


def _learn(learner: LocalLearner, environment: Environment, episodes: int) -> str | None:
    """Iterate up to that many episodes; the cause where learning diverged."""
    while environment.episodes < episodes:
        environment.begin(environment.iteration + 1)
        try:
            learner.iterate(Experience(environment))
        except (Diverged, np.linalg.LinAlgError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
            return f"diverged in iteration {environment.iteration}: {error}"
    return None
