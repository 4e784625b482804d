"""One worker under supervision: its news, its heartbeats, its end."""

from __future__ import annotations

import logging
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from solar_cli.errors import SolarError
from solar_cli.experiment.engine import Job
from solar_cli.experiment.matrix import Action, Plan
from solar_cli.experiment.messages import Message
from solar_cli.store.records import AttemptRecord, Fenced, Outcome

if TYPE_CHECKING:
    from solar_cli.store.store import Store

BEAT_SECONDS = 5.0
"""between heartbeats: the lease of 60 s bears several that are late"""
OUTSIDE = frozenset({signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP})
"""signals that come from outside: the worker did nothing wrong and is taken up again"""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Result:
    """What became of one plan."""

    plan: Plan
    outcome: Outcome | None
    """None for a cell that this run did not compute"""
    cause: str
    """why it is not finished, in one line; what to know of it, or nothing, where it is"""

    @property
    def finished(self) -> bool:
        """Whether the store has the whole cell."""
        if self.outcome is None:
            return self.plan.action in (Action.SKIP, Action.STALE)
        return self.outcome is Outcome.FINISHED


class Supervision:
    """Of the worker ``job``, which makes an attempt at ``plan``'s cell."""

    def __init__(
        self, store: Store, plan: Plan, attempt: int, job: Job, seconds_an_episode: float | None
    ) -> None:
        self.plan = plan
        self.message: Message | None = None
        """where the worker stands; None before it has said so"""
        self._store = store
        self._attempt = attempt
        self._job = job
        self._asked = False
        self._killed = False
        self._oom_kills = _oom_kills()
        self._pace = seconds_an_episode
        self._beaten = self._began = self._paced = time.monotonic()
        self._first_episodes: int | None = None

    @property
    def job(self) -> Job:
        """The worker, for its engine to wait for."""
        return self._job

    def stop(self) -> None:
        """Ask the worker, once, to save its state and end."""
        if not self._asked:
            self._asked = True
            self._job.stop()

    def kill(self) -> None:
        """End the worker at once."""
        self._killed = True
        self._job.kill()

    def attend(self) -> Result | None:
        """Take in the news and send the heartbeat; the result, when the worker has ended."""
        code = self._job.exit_code()  # before the last messages are read
        for message in self._job.messages():
            self._hear(message)
        if code is not None:
            return self._settle(code)
        if time.monotonic() - self._beaten < BEAT_SECONDS:
            return None
        try:
            self._beat()
        except Fenced as error:
            if self._newest() is None:  # another run has the cell
                self.kill()
                return Result(self.plan, None, str(error))
            # else the worker has just ended the attempt, and will be gone in a moment
        except SolarError as error:
            # The worker meets the same trouble where it matters; a late heartbeat does no harm.
            log.warning("no heartbeat for %s: %s", self.plan.cell.title, error)
        return None

    def seconds_left(self) -> float | None:
        """How long the cell will take at its pace, or at that of others like it; None: unknown."""
        if self._pace is None or self.message is None:
            return None
        missing = self.plan.target - self.message.episodes
        return max(0.0, self._pace * missing - (time.monotonic() - self._paced))

    def abandon(self, cause: str) -> None:
        """Kill the worker and end the attempt, after an error of the scheduler itself."""
        self.kill()
        self._store.end(self.plan.cell.hash, self._attempt, Outcome.INTERRUPTED, cause)

    def _hear(self, message: Message) -> None:
        before, self.message = self.message, message
        if before is not None and message.episodes > before.episodes:
            if self._first_episodes is None:
                self._first_episodes = before.episodes
            self._paced = time.monotonic()
            self._pace = (self._paced - self._began) / (message.episodes - self._first_episodes)

    def _beat(self) -> None:
        self._beaten = time.monotonic()
        message = self.message
        activity, fraction = (message.activity, message.fraction) if message else ("starting", 0.0)
        self._store.beat(self.plan.cell.hash, self._attempt, activity, fraction)

    def _newest(self) -> AttemptRecord | None:
        """The attempt, as long as no other has followed it."""
        attempts = self._store.attempts(self.plan.cell.hash)
        return attempts[-1] if attempts and attempts[-1].number == self._attempt else None

    def _settle(self, code: int) -> Result:
        """The end as the worker stored it, or, when it could not, as its exit code tells."""
        outcome, cause = self._explain(code)
        try:
            self._store.end(self.plan.cell.hash, self._attempt, outcome, cause)
        except Fenced as error:
            stored = self._newest()
            if stored is None or stored.outcome is None:
                return Result(self.plan, None, str(error))
            return Result(self.plan, stored.outcome, stored.error or "")
        except SolarError as error:
            return Result(self.plan, Outcome.INTERRUPTED, str(error))
        return Result(self.plan, outcome, cause)

    def _explain(self, code: int) -> tuple[Outcome, str]:
        """What the exit code of a worker means that could not say it itself."""
        if self._killed:
            return Outcome.INTERRUPTED, "stopped at once on request"
        if code >= 0:
            return Outcome.FAILED, f"the worker ended with exit code {code}: see the end of its log"
        number = -code
        if self._asked and number == signal.SIGTERM:
            return Outcome.INTERRUPTED, "stopped on request while it started"
        name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
        if number not in OUTSIDE:
            return Outcome.FAILED, f"the worker crashed with {name}: see the end of its log"
        cause = f"the worker was ended by {name}"
        if number == signal.SIGKILL and _oom_kills() != self._oom_kills:
            cause += " while memory ran out: use fewer --workers"
        return Outcome.INTERRUPTED, cause


def _oom_kills() -> str | None:
    """How often the kernel has killed for want of memory since boot; None where it is not said."""
    try:
        lines = Path("/proc/vmstat").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((line for line in lines if line.startswith("oom_kill ")), None)
