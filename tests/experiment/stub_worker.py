"""A worker without learning that starts fast: ``STUB`` says what each seed does."""

import json
import os
import signal
import sys
import time
from typing import Any

ARGUMENTS = dict(zip(sys.argv[1::2], sys.argv[2::2], strict=True))
CELL, ATTEMPT, TARGET = (ARGUMENTS[f"--{name}"] for name in ("cell", "attempt", "target"))
MINUTES = 200.0
"""longer than any machine is busy: a test that waits for this has failed"""
stopping = False


def stop(*_: object) -> None:
    global stopping
    stopping = True


def say(activity: str, fraction: float, episodes: int = 0, headline: float | None = None) -> None:
    message = {"iteration": 1, "episodes": episodes, "headline": headline}
    line = json.dumps(message | {"activity": activity, "fraction": fraction}) + "\n"
    os.write(int(ARGUMENTS["--pipe"]), line.encode())


def work(seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end and not stopping:
        say("working", 0.5)
        time.sleep(0.02)


def store() -> Any:
    from solar_cli.store.store import Store  # the slow part: most stubs do without

    return Store.open()


def finish(seconds: float) -> None:
    work(seconds)
    from solar_cli.store.records import Outcome

    totals = {"steps": 0, "simulated_seconds": 0.0, "seconds": 1.0}
    with store() as opened:
        if not stopping:
            opened.commit(CELL, int(ATTEMPT), iteration=1, episodes=int(TARGET), **totals)
            say("done", 1.0, int(TARGET), 0.5)
        outcome = Outcome.INTERRUPTED if stopping else Outcome.FINISHED
        opened.end(CELL, int(ATTEMPT), outcome)


def lose_the_cell() -> None:
    """Another run takes the cell over."""
    from solar_cli.store.owner import Owner
    from solar_cli.store.records import Outcome

    with store() as opened:
        opened.end(CELL, int(ATTEMPT), Outcome.INTERRUPTED)
        opened.claim(CELL, Owner.of(os.getppid()), int(TARGET), {})
    work(MINUTES)
    print("unharmed", flush=True)


signal.signal(signal.SIGTERM, stop)
say("waking", 0.0)
print("argv", sys.argv, "threads", os.environ["OMP_NUM_THREADS"], flush=True)
what, _, detail = json.loads(os.environ["STUB"])[CELL].partition(":")
match what:
    case "finish":
        finish(float(detail or 0))
    case "exit":
        sys.exit(int(detail))
    case "signal":
        os.kill(os.getpid(), signal.Signals[detail])
        time.sleep(MINUTES)
    case "early":
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        say("importing", 0.0)
        time.sleep(MINUTES)
    case "deaf":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        say("deaf", 0.0)
        time.sleep(MINUTES)
    case "lose":
        lose_the_cell()
