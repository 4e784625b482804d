"""One attempt at one cell, from where the last one stopped: restore, iterate, evaluate, commit.

Nothing here changes what is learned. Evaluations have their own streams and simulator; checkpoints
may fall wherever the clock says, because a learner's state is consistent at every pulse, at every
step of the simulator, and so whenever an attempt is asked to stop. Of what it has computed, the
episodes that are under way then are lost, and made again by the next attempt.
"""

from __future__ import annotations

import logging
import math
import resource
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch

from solar_cli.envs import build_task
from solar_cli.episodes import Episodes, Evaluation, Policy
from solar_cli.errors import SolarError
from solar_cli.experience import Environment, Experience
from solar_cli.experiment.checkpointing import Checkpoints
from solar_cli.experiment.exhibits import SHOWN, exhibit
from solar_cli.experiment.judge import Judge, measured
from solar_cli.experiment.messages import Message
from solar_cli.experiment.watched import WatchedTask
from solar_cli.methods import Diverged, Learner
from solar_cli.settings import Cell, load, method
from solar_cli.stopwatch import Stopwatch
from solar_cli.store.records import CheckpointRecord, Metric
from solar_cli.store.results import EPISODES
from solar_cli.store.store import Store
from solar_cli.streams import Streams
from solar_cli.wording import counted

TRAINING = ("seconds_training", "seconds_discarded", "seconds_judging")
"""metrics of a method that trains networks: of what it kept, of what it threw away, and of encoding
episodes and judging the model by them"""

log = logging.getLogger(__name__)


class Stopped(BaseException):
    """Asked to stop, and all is saved; the message says where it stands.

    Not an `Exception`, so that no method can swallow it.
    """


class Supervisor(Protocol):
    """Whoever started the attempt."""

    @property
    def stopping(self) -> bool:
        """Whether the attempt is to save its state and stop."""

    def tell(self, message: Message) -> None:
        """Hear where the attempt stands; raises when there is nobody left to work for."""


class Session:
    """An attempt that computes a cell up to ``target`` episodes."""

    def __init__(
        self,
        store: Store,
        cell: Cell,
        attempt: int,
        target: int,
        supervisor: Supervisor,
        *,
        device: str,
        checkpoint_seconds: float,
    ) -> None:
        self._store = store
        self._cell = cell
        self._attempt = attempt
        self._target = target
        self._supervisor = supervisor
        self._checkpoint_seconds = checkpoint_seconds
        self._iteration = 0
        self._inside = False  # an iteration has begun and is not committed
        self._learned: dict[str, float] | None = None  # metrics of an iteration yet to be judged
        self._position = 0
        self._episodes = 0  # committed with the last whole iteration
        self._headline: float | None = None
        self._evaluation: Evaluation | None = None
        self._seconds = 0.0  # of computing, in earlier attempts
        self._began = self._saved = time.monotonic()
        self._unsaved = True  # something has come since the last checkpoint
        self._watch = Stopwatch()  # of the iteration
        streams, task = Streams(cell.seed), cell.configuration.task
        self._checkpoints = Checkpoints(store, cell.hash, attempt)
        self._judge = Judge(cell, partial(self._pause, "evaluating"))
        self._simulator = WatchedTask(build_task(task), self._collecting)
        self.environment = Environment(
            self._simulator,
            task,
            streams.under("environment"),
            store.folder(cell.hash) / EPISODES,
        )
        self.learner: Learner = load(method(cell.method).learner)(
            cell.configuration.method, task, streams.under("learner"), device, self._pulse
        )

    @property
    def place(self) -> str:
        """Where it stands, for a message about what went wrong there."""
        return f"iteration {self._iteration}, {counted(self.environment.episodes, 'episode')}"

    @property
    def notes(self) -> list[str]:
        """What a reader of the results should know of this attempt, though it went on."""
        return self._checkpoints.damaged

    def run(self) -> None:
        """Compute what is missing. Raises `Diverged`, `Stopped`, or whatever went wrong."""
        if not self._restore():
            self._conclude({})
        while self._inside or self.environment.episodes < self._target:
            if self._supervisor.stopping:
                raise Stopped(self.place)
            if self._learned is None:
                self._learned = self._iterate()
            self._conclude(self._learned)
        self._exhibit()

    def _iterate(self) -> dict[str, float]:
        """One iteration, or the rest of one that a checkpoint was made inside of; its metrics."""
        if not self._inside:
            self._iteration += 1
            self._position = 0
            self._inside = True
        self.environment.begin(self._iteration)
        self._tell("starting")
        experience = Experience(self.environment)
        experience.collect = self._collect
        try:
            with self._watch.running("control"):
                learned = self.learner.iterate(experience)
        except (np.linalg.LinAlgError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
            # What numbers that are no longer finite look like to a factorisation.
            raise Diverged(str(error)) from error
        metrics = learned | self.environment.summary(self._iteration)
        self._unsaved = True
        return {name: float(value) for name, value in metrics.items()}

    def _collect(
        self, policy: Policy, episodes: int, *, noisy: bool = True, kept: bool = True
    ) -> Episodes:
        """As `Environment.collect`, watched and timed."""
        self._simulator.expect(episodes)
        with self._watch.running("collecting"):
            return self.environment.collect(policy, episodes, noisy=noisy, kept=kept)

    def _conclude(self, train: dict[str, float]) -> None:
        """Evaluate; then checkpoint file, metrics and progress become durable, in this order."""
        metrics = [Metric(name, value) for name, value in train.items()]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        metrics.append(Metric("peak_memory_bytes", peak))
        _require_finite_return(metrics)
        with self._watch.running("evaluating"):
            self._evaluation = self._judge.evaluate(self.learner.policy, self._iteration)
            judged = measured(self._evaluation)
            _require_finite_return(judged)
            if self._iteration > 0:
                diagnosed = self.learner.diagnose(self._evaluation)
                metrics += [Metric(name, value, "model") for name, value in diagnosed.items()]
        headline = self._cell.configuration.evaluation.headline
        self._headline = {metric.name: metric.value for metric in judged}.get(headline)
        self._episodes = self.environment.episodes
        self._inside, self._learned = False, None
        checkpoint = self._save() if self._iteration > 0 else None
        self._commit(metrics + judged + self._timings(train), checkpoint)
        log.info("%s: %s %s", self.place, headline, self._headline)

    def _timings(self, train: Mapping[str, float]) -> list[Metric]:
        """Seconds of the iteration by activity, those of training aside, which the method measures.

        Control is all else that it does. Saving is that of checkpoints, and the commit before.
        """
        seconds = self._watch.seconds()
        self._watch.go_on_from({})
        if "control" in seconds:
            seconds["control"] -= sum(train.get(name, 0.0) for name in TRAINING)
        return [Metric(f"seconds_{activity}", value) for activity, value in seconds.items()]

    def _exhibit(self) -> None:
        """Keep what the report shows of the final policy."""
        self._tell("writing pictures")
        if self._evaluation is None:  # an earlier attempt was killed just before this step
            self._evaluation = self._judge.evaluate(self.learner.policy, self._iteration)
        exhibit(
            self._store,
            self._cell.hash,
            self._attempt,
            self._iteration,
            self._judge.pictures(self._evaluation, self._iteration, SHOWN),
            self._evaluation,
            self.learner,
        )

    def _pulse(self, activity: str, fraction: float) -> None:
        """What a learner calls every few gradient steps, where its state is consistent."""
        self._unsaved = True
        self._pause(activity, fraction)

    def _collecting(self, fraction: float) -> None:
        """What the simulator says at every step of episodes for the learner."""
        self._pause("collecting", fraction)
        self._unsaved = self._unsaved or fraction >= 1.0  # they count from now on

    def _pause(self, activity: str, fraction: float) -> None:
        """Say where it stands; save what is new when it is time to; stop when asked to."""
        self._tell(activity, fraction)
        stopping = self._supervisor.stopping
        due = time.monotonic() - self._saved >= self._checkpoint_seconds
        if self._inside and self._unsaved and (stopping or due):
            self._commit([], self._save())
        if stopping:
            raise Stopped(self.place)

    def _tell(self, activity: str, fraction: float = 0.0) -> None:
        self._supervisor.tell(
            Message(self._iteration, self._episodes, self._headline, activity, fraction)
        )

    def _computed(self) -> float:
        """Seconds of computing over all attempts; what a kill destroyed is not in it."""
        return self._seconds + time.monotonic() - self._began

    def _save(self) -> CheckpointRecord:
        state = {
            "inside": self._inside,
            "learned": self._learned,
            "episodes": self._episodes,
            "headline": self._headline,
            "seconds": self._computed(),
            "spent": self._watch.seconds() if self._inside else {},
            "environment": self.environment.state_dict(),
            "learner": self.learner.state_dict(),
        }
        with self._watch.running("saving"):
            record = self._checkpoints.save(
                state,
                self._iteration,
                self.environment.episodes,
                self._position,
                complete=not self._inside,
            )
        self._position += 1
        self._saved, self._unsaved = time.monotonic(), False
        return record

    def _commit(self, metrics: Sequence[Metric], checkpoint: CheckpointRecord | None) -> None:
        """One transaction. The supervisor is told first, so that an orphan writes nothing."""
        self._tell("saving")
        steps = self.environment.steps
        with self._watch.running("saving"):
            self._store.commit(
                self._cell.hash,
                self._attempt,
                iteration=self._iteration,
                episodes=self.environment.episodes,
                steps=steps,
                simulated_seconds=steps * self._cell.configuration.task.step_seconds,
                seconds=self._computed(),
                metrics=metrics,
                checkpoint=checkpoint,
            )
            if checkpoint is not None:
                self._checkpoints.trim()

    def _restore(self) -> bool:
        """Take up the newest sound checkpoint; False where there is none."""
        self._tell("restoring")
        found = self._checkpoints.restore()
        if found is None:
            return False
        record, state = found
        self._take_up(record, state)
        self._iteration, self._position = record.iteration, record.position + 1
        self._inside, self._learned = state["inside"], state.get("learned")  # once not saved
        self._unsaved = False
        self._episodes, self._headline = state["episodes"], state["headline"]
        self._seconds = state["seconds"]
        self._watch.go_on_from(state.get("spent", {}))
        log.info("going on from %s: %s", record.path, self.place)
        return True

    def _take_up(self, record: CheckpointRecord, state: dict[str, Any]) -> None:
        try:
            self.environment.load_state_dict(state["environment"])
            self.learner.load_state_dict(state["learner"])
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise SolarError(
                f"checkpoint {record.path} does not fit the present code "
                f"({type(error).__name__}: {error}): start the cell anew with --redo"
            ) from error


def _require_finite_return(metrics: Sequence[Metric]) -> None:
    """A cost that is no number ends learning, whatever the method thinks of it."""
    for metric in metrics:
        if metric.name == "return" and not math.isfinite(metric.value):
            source = "evaluation" if metric.split == "noise_free" else "collected"
            raise Diverged(f"the mean return of the {source} episodes is {metric.value}")
