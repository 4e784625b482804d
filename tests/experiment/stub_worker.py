"""A worker without learning, so that it starts fast: ``STUB`` says what each seed does."""

import os
import signal
import sys
import time

from solar_cli.experiment.messages import Message
from solar_cli.experiment.worker import Pipe, _parser
from solar_cli.store.records import Outcome
from solar_cli.store.store import Store

options = _parser().parse_args()
pipe = Pipe(options.pipe)
print("argv", sys.argv, "threads", os.environ["OMP_NUM_THREADS"])
with Store.open() as store:
    cell = store.find(options.cell).cell
    what, _, detail = os.environ["STUB"].split(",")[cell.seed].partition(":")
    pipe.tell(Message(1, 0, None, "waking", 0.0))

    def work(seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and not pipe.stopping:
            pipe.tell(Message(1, 0, None, "working", 0.5))
            time.sleep(0.02)

    match what:
        case "finish":
            work(float(detail or 0))
            outcome = Outcome.INTERRUPTED if pipe.stopping else Outcome.FINISHED
            if not pipe.stopping:
                store.commit(
                    options.cell,
                    options.attempt,
                    iteration=1,
                    episodes=options.target,
                    steps=0,
                    simulated_seconds=0.0,
                    seconds=1.0,
                )
                pipe.tell(Message(1, options.target, 0.5, "done", 1.0))
            store.end(options.cell, options.attempt, outcome)
        case "exit":
            sys.exit(int(detail))
        case "signal":
            os.kill(os.getpid(), signal.Signals[detail])
            time.sleep(60)
        case "deaf":
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            time.sleep(60)
        case "taken":
            store.end(options.cell, options.attempt, Outcome.INTERRUPTED)
            from solar_cli.store.owner import Owner

            store.claim(options.cell, Owner.of(os.getppid()), options.target, {})
            work(60)
