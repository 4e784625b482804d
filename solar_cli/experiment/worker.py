"""The process that computes one cell: ``python -m solar_cli.experiment.worker``.

Its supervisor reads where it stands from a pipe (`messages`), and stops it with SIGTERM: it saves
its state at the next pulse or step of the simulator, and ends. When the pipe has no reader any
more, the supervisor was killed: the worker ends there without writing, because the cell may have a
new owner. Standard output and error are the cell's log.
"""

from __future__ import annotations

import argparse
import errno
import fcntl
import logging
import os
import resource
import select
import signal
import sys
import threading
import time
import traceback
from collections.abc import Sequence

from sqlalchemy.exc import DBAPIError

from solar_cli.errors import LostFiles, SolarError
from solar_cli.experiment.messages import Message
from solar_cli.store.records import Fenced, Outcome
from solar_cli.store.store import Store

MESSAGE_SECONDS = 0.2
"""between messages: as often as a live table is read"""
ORPHAN_SECONDS = 120.0
"""after which a worker without supervisor ends even where no pulse comes: it hangs"""

log = logging.getLogger("solar")


class Orphaned(BaseException):
    """The supervisor is gone. Not an `Exception`, so that no method can swallow it."""


class Pipe:
    """The worker's end: a `Supervisor` behind a file descriptor."""

    def __init__(self, descriptor: int) -> None:
        # A worker must never wait for a supervisor that is stopped or slow: what does not fit into
        # the pipe is dropped, the next message says it all again.
        flags = fcntl.fcntl(descriptor, fcntl.F_GETFL)
        fcntl.fcntl(descriptor, fcntl.F_SETFL, flags | os.O_NONBLOCK)
        os.set_inheritable(descriptor, False)
        self._descriptor = descriptor
        self._poll = select.poll()
        self._poll.register(descriptor, 0)  # errors are always reported
        self._told = (0, "")
        self._when = 0.0
        self.stopping = False
        signal.signal(signal.SIGTERM, self._stop)
        threading.Thread(target=self._watch, daemon=True).start()

    def tell(self, message: Message) -> None:
        """Send, unless the last message is young and said the same. Raises `Orphaned`."""
        if self._poll.poll(0):
            raise Orphaned
        now, said = time.monotonic(), (message.iteration, message.activity)
        if said == self._told and now - self._when < MESSAGE_SECONDS:
            return
        self._told, self._when = said, now
        try:
            os.write(self._descriptor, message.line())
        except BlockingIOError:
            pass
        except BrokenPipeError as error:
            raise Orphaned from error

    def _stop(self, *_: object) -> None:
        self.stopping = True

    def _watch(self) -> None:
        """End the process for sure when the supervisor is gone and no pulse comes."""
        watcher = select.poll()
        watcher.register(self._descriptor, 0)
        watcher.poll()
        time.sleep(ORPHAN_SECONDS)
        os._exit(1)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute, and store how the attempt ended; 0 when the cell is finished."""
    options = _parser().parse_args(arguments)
    pipe = Pipe(options.pipe)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    logging.captureWarnings(True)
    log.info("attempt %d, process %d", options.attempt, os.getpid())
    with Store.open(options.db) as store:
        try:
            outcome, error = compute(store, options, pipe)
            log.info("%s%s", outcome.value, f": {error}" if error else "")
            store.end(options.cell, options.attempt, outcome, error)
        except (Orphaned, Fenced) as error:
            log.warning("ends without a trace: %s", str(error) or "its supervisor is gone")
            return 1
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    log.info("peak memory %d MiB", peak // 1024)
    return 0 if outcome is Outcome.FINISHED else 1


def compute(store: Store, options: argparse.Namespace, pipe: Pipe) -> tuple[Outcome, str | None]:
    """Make the attempt; how it ended, and why, in one line."""
    # Imported here, where a broken package becomes the attempt's error.
    try:
        from solar_cli.experiment.session import Session, Stopped
        from solar_cli.methods import Diverged

        device = prepare_torch(options.device)
        cell = store.find(options.cell).cell
        try:
            session = Session(
                store,
                cell,
                options.attempt,
                options.target,
                pipe,
                device=device,
                checkpoint_seconds=options.checkpoint_seconds,
            )
            session.run()
        except Stopped as stop:
            return Outcome.INTERRUPTED, f"stopped on request in {stop}"
        except Diverged as error:
            traceback.print_exc()
            return Outcome.DIVERGED, f"{session.place}: {error}"
    except Fenced:
        raise
    except Exception as error:
        traceback.print_exc()
        return _failure(error)
    return Outcome.FINISHED, "; ".join(session.notes) or None


def _failure(error: Exception) -> tuple[Outcome, str]:
    if isinstance(error, SolarError):
        line = str(error)
    else:
        line = traceback.format_exception_only(error)[-1].strip()
    return Outcome.INTERRUPTED if _from_outside(error) else Outcome.FAILED, line


def _from_outside(error: BaseException | None) -> bool:
    """Whether disk or database fail, or files are gone: the next run goes on, without --retry.

    Nor does it need --retry to be content with the episodes that the cell has.
    """
    if error is None:
        return False
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    return full or isinstance(error, DBAPIError | LostFiles) or _from_outside(error.__cause__)


def prepare_torch(device: str) -> str:
    """Make torch repeat itself bit for bit; ``auto`` becomes the device that there is."""
    import torch

    torch.set_num_threads(1)
    torch.set_num_interop_threads(1)
    torch.use_deterministic_algorithms(True)
    # Else every new tensor is filled with NaN first: a twentieth of a training.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    # A GPU's convolutions round to 10 bits unless told not to, and learn something else.
    torch.backends.cudnn.allow_tf32 = False
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise SolarError(
            "--device cuda: torch sees no GPU here; use --device cpu, or install a CUDA build"
        )
    return "cuda" if device == "auto" and available else device.replace("auto", "cpu")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m solar_cli.experiment.worker")
    parser.add_argument("--db", help="the database; SOLAR_DB without it")
    parser.add_argument("--cell", required=True, help="hash of the cell")
    parser.add_argument("--attempt", type=int, required=True, help="as claimed by the supervisor")
    parser.add_argument("--target", type=int, required=True, help="episodes to stop at")
    parser.add_argument("--pipe", type=int, required=True, help="to the supervisor")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--checkpoint-seconds", type=float, required=True)
    return parser


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    # All is stored. Taking torch apart object by object would take as long as a small cell does.
    os._exit(code)
