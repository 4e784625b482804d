"""The worker, but it kills with -9 at a moment that ``DIE`` names: ``MOMENT:NTH:WHO``.

The moment counts from the start of the process; who is ``worker``, ``scheduler`` or ``both``.
"""

import os
import signal
import sys
from collections.abc import Callable
from typing import Any

from solar_cli.envs.task import LoopTask, RowTask
from solar_cli.experience import Environment
from solar_cli.experiment import checkpointing, session, worker
from solar_cli.experiment.judge import Judge
from solar_cli.store.store import Store

moment, nth, who = os.environ["DIE"].split(":")
count = 0


def strike() -> None:
    """Kill, at the nth call."""
    global count
    count += 1
    if count != int(nth):
        return
    with open(os.environ["KILLS"], "a") as kills:
        kills.write(f"{moment}:{nth}:{who}\n")
        kills.flush()
    if who in ("scheduler", "both"):
        os.kill(os.getppid(), signal.SIGKILL)
    if who in ("worker", "both"):
        os.kill(os.getpid(), signal.SIGKILL)


def after(owner: Any, name: str) -> None:
    """Strike when ``owner.name`` has returned."""
    whole = getattr(owner, name)

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        result = whole(*args, **kwargs)
        strike()
        return result

    setattr(owner, name, wrapped)


def inside_evaluation() -> None:
    """Strike at steps of a simulator that a judge runs."""
    whole: Callable[..., Any] = Judge.evaluate
    kinds = (RowTask, LoopTask)

    def evaluate(self: Judge, *args: Any) -> Any:
        steps = [kind.step for kind in kinds]
        for kind in kinds:
            after(kind, "step")
        try:
            return whole(self, *args)
        finally:
            for kind, step in zip(kinds, steps, strict=True):
                kind.step = step  # type: ignore[method-assign]

    Judge.evaluate = evaluate  # type: ignore[method-assign]


MOMENTS: dict[str, Callable[[], None]] = {
    "collecting": lambda: after(session.Session, "_collecting"),  # at a step of the simulator
    "collected": lambda: after(Environment, "collect"),
    "training": lambda: after(session.Session, "_pulse"),
    "updated": lambda: after(Environment, "summary"),  # a new policy, not yet evaluated
    "evaluating": inside_evaluation,
    "renamed": lambda: after(checkpointing, "save"),  # the file is there, its row is not
    "committed": lambda: after(Store, "commit"),
}
MOMENTS[moment]()
sys.exit(worker.main())
