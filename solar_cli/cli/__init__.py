"""The command ``solar``: one file a command; each parses, calls the library, and prints."""

from __future__ import annotations

import gc
import io
import os
import sys
from collections.abc import Sequence

import typer

from solar_cli.cli import (
    compare,
    diagnose,
    doctor,
    export,
    methods,
    report,
    rm,
    run,
    show,
    status,
    tasks,
)
from solar_cli.cli.printing import complain
from solar_cli.errors import SolarError

GARBAGE_AFTER = 50_000
"""New objects between collections of garbage: imports make many and leave none. At Python's own
700 a tenth of the time of a short command goes into looking."""
INTERRUPTED = 130
"""Exit code of a command that Ctrl-C stopped: 128 + SIGINT."""

app = typer.Typer(
    help="Run model-based reinforcement learning from images, and compare what was learned.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,  # it prints local variables, and one may hold a password
    context_settings={"help_option_names": ["-h", "--help"]},
)
for module in (run, status, show, report, compare, diagnose, tasks, methods, export, rm, doctor):
    app.command(module.__name__.rpartition(".")[2])(module.command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; the only place where errors are shown.

    2 for bad input, 1 for what could not be done, 130 after Ctrl-C.
    """
    gc.set_threshold(GARBAGE_AFTER)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by whoever started this
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal may lack a letter of a table
    try:
        code = _obey(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        silence_output()
        return 1
    except OSError as error:  # of files, the store has made a SolarError
        silence_output()
        place = error.filename or "standard output"
        complain(f"solar: {place}: {error.strerror or error}; make room, or write elsewhere")
        return 1
    return code


def _obey(arguments: Sequence[str] | None) -> int:
    """Run one command, show its error, and return its exit code."""
    try:
        code = app(arguments, prog_name="solar", standalone_mode=False)
    except SolarError as error:
        complain(f"solar: {error}")
        return error.exit_code
    except typer.TyperException as error:
        if message := error.format_message():  # it is empty where the help text was shown
            complain(f"solar: {message}")
        return error.exit_code
    except typer.Abort:
        complain("solar: nothing was done")
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED
    return code if isinstance(code, int) else 0


def silence_output() -> None:
    """Whoever read our output, such as ``head``, has seen enough: say nothing more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
