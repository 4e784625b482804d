"""Computes a matrix: one supervised process a cell, as many at a time as the machine holds.

The scheduler owns the attempts: it claims a cell, starts its worker, sends the heartbeats and sees
to it that the attempt ends, however the worker did. It may be killed without harm: its workers
notice and end, and its cells are free at once.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from solar_cli.errors import SolarError
from solar_cli.experiment import matrix
from solar_cli.experiment.engine import Engine, LocalEngine, Order
from solar_cli.experiment.estimates import WORKER_BYTES, kind_of, measured_speeds
from solar_cli.experiment.matrix import Action, Plan
from solar_cli.experiment.messages import Message
from solar_cli.experiment.provenance import cores, memory_bytes, provenance
from solar_cli.experiment.supervision import Result, Supervision
from solar_cli.settings import Cell
from solar_cli.store.owner import Owner
from solar_cli.store.records import CellBusy, CellRecord, Outcome

if TYPE_CHECKING:
    from solar_cli.store.store import Store

__all__ = ["Event", "Result", "default_workers", "run"]

WAIT_SECONDS = 0.25
"""longest wait for news; a signal is noticed after it"""
TOGETHER_SECONDS = 0.5
"""in which signals are one request, the second of which would not let workers save: a closing
terminal may send SIGHUP twice, and a launcher may forward what the terminal has sent to both"""
CHECKPOINT_SECONDS = 60.0
"""between checkpoints inside an iteration: a run that is killed every few minutes still ends, and
saving, some 20 ms, costs nothing"""
STOPPED = "the run was stopped"


@dataclass(frozen=True)
class Event:
    """News of a cell, for whoever watches."""

    kind: Literal["started", "progress", "ended"]
    plan: Plan
    message: Message | None = None
    """where the worker stands; None before it has said so"""
    seconds_left: float | None = None
    """None while nothing is known of the speed"""
    result: Result | None = None
    """of an end"""


def run(
    plans: Sequence[Plan],
    store: Store,
    *,
    workers: int | None = None,
    engine: Engine | None = None,
    report: Callable[[Event], None] = lambda _: None,
    device: str = "auto",
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
) -> list[Result]:
    """Compute what ``plans`` ask for; one result a plan, in their order.

    Ctrl-C, SIGTERM and SIGHUP stop the workers at their next pulse or step of the simulator, where
    they save their state; a second one ends them at once. The results are complete in both cases.
    """
    work = [plan for plan in plans if plan.is_work]
    results: dict[str, Result] = {}
    if work:
        scheduler = Scheduler(store, engine or LocalEngine(), report, device, checkpoint_seconds)
        results = scheduler.run(work, workers or default_workers(len(work)))
    return [results.get(plan.cell.hash, Result(plan, None, plan.why)) for plan in plans]


def default_workers(pending: int) -> int:
    """As many workers as there are cores and memory for, at most one a pending cell."""
    available = memory_bytes("MemAvailable")
    fitting = cores() if available is None else available // WORKER_BYTES
    return max(1, min(cores(), fitting, pending))


class Scheduler:
    """What `run` needs to know while it runs."""

    def __init__(
        self,
        store: Store,
        engine: Engine,
        report: Callable[[Event], None],
        device: str,
        checkpoint_seconds: float,
    ) -> None:
        self._store = store
        self._engine = engine
        self._report = report
        self._device = device
        self._checkpoint_seconds = checkpoint_seconds
        self._provenance = provenance(device)
        self._owner = Owner.current()
        self._queue: deque[Plan] = deque()
        self._elsewhere: list[Plan] = []
        self._running: list[Supervision] = []
        self._results: dict[str, Result] = {}
        self._stops = 0
        self._stopped = -math.inf

    def run(self, work: Sequence[Plan], workers: int) -> dict[str, Result]:
        """Work until nothing is left, or until stopped; results by hash of the cell."""
        self._queue.extend(work)
        self._speeds = measured_speeds(self._store, [plan.cell for plan in work])
        with _signals(self._stop):
            try:
                while self._queue or self._running:
                    while self._queue and len(self._running) < workers and not self._stops:
                        self._start(self._queue.popleft())
                    self._engine.wait([watched.job for watched in self._running], WAIT_SECONDS)
                    self._obey()
                    for watched in list(self._running):
                        self._attend(watched)
                    if not self._queue and not self._running:
                        self._look_elsewhere()
            finally:
                closed = isinstance(sys.exception(), BrokenPipeError)
                cause = f"{STOPPED}: nobody reads its output" if closed else "the scheduler failed"
                for watched in self._running:  # only after an error
                    with suppress(SolarError):
                        watched.abandon(cause)
        return self._results

    def _stop(self) -> None:
        """Count a request, of which this signal may be one of several."""
        now = time.monotonic()
        if now - self._stopped >= TOGETHER_SECONDS:
            self._stopped = now
            self._stops += 1

    def _obey(self) -> None:
        """Do what the signals so far ask for."""
        if self._stops == 0:
            return
        while self._queue:
            self._end(Result(self._queue.popleft(), None, STOPPED))
        for watched in self._running:
            watched.stop() if self._stops == 1 else watched.kill()

    def _start(self, planned: Plan) -> None:
        """Claim a cell and start its worker, unless somebody else has meanwhile."""
        try:
            plan = self._current(planned)
            if not plan.is_work:
                self._leave(plan, plan.why)
                return
            attempt = self._claim(plan)
        except CellBusy as error:
            self._leave(planned, str(error))
            return
        except SolarError as error:
            self._end(Result(planned, None, str(error)))
            return
        cell = plan.cell.hash
        order = Order(
            address=self._store.address,
            home=self._store.home,
            cell=cell,
            attempt=attempt,
            target=plan.target,
            device=self._device,
            checkpoint_seconds=self._checkpoint_seconds,
            log=self._store.folder(cell) / "log.txt",
        )
        try:
            job = self._engine.start(order)
        except OSError as error:
            cause = f"no worker can be started: {error}"
            self._store.end(cell, attempt, Outcome.INTERRUPTED, cause)
            self._end(Result(plan, Outcome.INTERRUPTED, cause))
            return
        pace = self._speeds.get(kind_of(plan.cell))
        self._running.append(Supervision(self._store, plan, attempt, job, pace))
        self._report(Event("started", plan))

    def _current(self, planned: Plan) -> Plan:
        """The plan as it was made, or a new one where another run has touched the cell since.

        ``--redo`` and ``--retry`` were said of what was there then, so the new plan knows neither.
        """
        current = self._planned(planned.cell, planned.target)
        return planned if _attempts(current.record) == _attempts(planned.record) else current

    def _planned(self, cell: Cell, target: int) -> Plan:
        [plan] = matrix.plan(self._store, [cell], target, present=self._provenance)
        return plan

    def _claim(self, plan: Plan) -> int:
        if plan.action is Action.REDO:
            self._store.remove([plan.cell.hash])
        self._store.add([plan.cell])
        return self._store.claim(plan.cell.hash, self._owner, plan.target, self._provenance)

    def _attend(self, watched: Supervision) -> None:
        known = watched.message
        result = watched.attend()
        if watched.message is not known:
            news = Event("progress", watched.plan, watched.message, watched.seconds_left())
            self._report(news)
        if result is None:
            return
        self._running.remove(watched)
        if result.outcome is None:
            self._leave(watched.plan, result.cause)
        else:
            self._end(result, watched.message)

    def _leave(self, plan: Plan, why: str) -> None:
        """Another run has the cell, or has had it: look again in the end."""
        self._elsewhere.append(plan)
        self._results[plan.cell.hash] = Result(plan, None, why)

    def _end(self, result: Result, message: Message | None = None) -> None:
        self._results[result.plan.cell.hash] = result
        self._report(Event("ended", result.plan, message, result=result))

    def _look_elsewhere(self) -> None:
        """In the end, see what became of the cells that other runs were computing."""
        cells = [] if self._stops else [plan.cell for plan in self._elsewhere]
        targets = {plan.cell.hash: plan.target for plan in self._elsewhere}
        self._elsewhere.clear()
        for cell in cells:
            plan = self._planned(cell, targets[cell.hash])
            if plan.is_work:  # the other run has gone and left it
                self._queue.append(plan)
            else:
                self._end(Result(plan, None, plan.why))


def _attempts(record: CellRecord | None) -> tuple[Any, ...] | None:
    """What changes when somebody computes a cell, or removes it."""
    if record is None or record.last_attempt is None:
        return None
    return record.created, record.last_attempt.number


@contextmanager
def _signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call ``stop`` for each signal that asks the run to end; as before afterwards."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are the main thread's: a run in another one ends with its process
        return
    wanted = [
        number
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) is not signal.SIG_IGN  # as nohup leaves SIGHUP
    ]
    before = {number: signal.signal(number, lambda *_: stop()) for number in wanted}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
