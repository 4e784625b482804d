"""Progress of a running matrix: a live table on a terminal, else plain lines or lines of JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from solar_cli.cli.plans import kind
from solar_cli.cli.printing import console, duration, number, print_json, say, table
from solar_cli.wording import counted

if TYPE_CHECKING:
    from rich.table import Table

    from solar_cli.experiment.scheduler import Event

COLUMNS = ("cell", "iteration>", "episodes>", "headline measure>", "doing", "time left>")
Report = Callable[["Event"], None]


@contextmanager
def watching(json: bool, cells: int) -> Iterator[Report]:
    """What the scheduler reports its events to, as long as it computes that many cells."""
    if json:
        yield Lines(json_line)
    elif cells and console().is_terminal:
        from rich.live import Live

        board = Board(cells)
        with Live(get_renderable=board.table, console=console(), transient=True) as live:

            def report(event: Event) -> None:
                if board.take(event) and (line := plain_line(event)):
                    live.console.print(line)

            yield report
    else:
        yield Lines(say_line)


class Board:
    """What the live table shows: the newest state of each running cell, and counts."""

    def __init__(self, cells: int) -> None:
        self.running: dict[str, Event] = {}
        self.ended: set[str] = set()
        self.cells = cells

    def take(self, event: Event) -> bool:
        """Keep the news; whether it is an end."""
        key = event.plan.cell.hash
        if event.kind == "ended":
            self.running.pop(key, None)
            self.ended.add(key)
            return True
        self.running[key] = event
        return False

    def table(self) -> Table:
        """One row a running cell, below the counts."""
        waiting = max(0, self.cells - len(self.ended) - len(self.running))
        counts = f"{len(self.running)} running, {waiting} waiting, {len(self.ended)} ended"
        return table(COLUMNS, [row(event) for event in self.running.values()], counts)


def row(event: Event) -> tuple[object, ...]:
    """What the live table says of a cell."""
    plan, message = event.plan, event.message
    if message is None:
        return (plan.cell.title, "", f"{standing(event)[1]}/{plan.target}", "", "starting", "")
    iteration, episodes = standing(event)
    return (
        plan.cell.title,
        iteration,
        f"{episodes}/{plan.target}",
        headline(event),
        f"{message.activity} {message.fraction:.0%}" if message.fraction else message.activity,
        duration(event.seconds_left),
    )


def standing(event: Event) -> tuple[int, int]:
    """Iteration and episodes: what the worker says, or, before it has read its checkpoint, what
    the store has."""
    plan, message = event.plan, event.message
    told = (0, 0) if message is None else (message.iteration, message.episodes)
    goes_on = plan.action.value in ("resume", "continue")
    if told == (0, 0) and goes_on and plan.record is not None:
        return plan.record.iteration, plan.record.episodes
    return told


def headline(event: Event) -> str:
    """``final_distance 0.04``, or nothing before the first evaluation."""
    message = event.message
    if message is None or message.headline is None:
        return ""
    return f"{event.plan.cell.configuration.evaluation.headline} {number(message.headline)}"


class Lines:
    """Passes on starts, ends, and every cell's new iterations: enough for a log."""

    def __init__(self, emit: Report) -> None:
        self._emit = emit
        self._iterations: dict[str, int] = {}

    def __call__(self, event: Event) -> None:
        """Hear an event."""
        key, message = event.plan.cell.hash, event.message
        if event.kind == "progress":
            iteration = -1 if message is None else standing(event)[0]
            if self._iterations.get(key) == iteration:
                return
            self._iterations[key] = iteration
        self._emit(event)


def plain_line(event: Event) -> str:
    """An event as a line of text."""
    title, message, result = event.plan.cell.title, event.message, event.result
    if event.kind == "started":
        return f"{title}: started"
    iteration, episodes = standing(event)
    reached = f"{episodes}/{counted(event.plan.target, 'episode')}"
    where = "" if message is None else f"iteration {iteration}, {reached}"
    if event.kind == "ended" and result is not None:
        parts = [f"{title}: {kind(result)}", where, headline(event), result.cause]
    else:
        left = f"{duration(event.seconds_left)} left" if event.seconds_left else ""
        parts = [f"{title}: {where}", headline(event), left]
    return ", ".join(part for part in parts if part)


def say_line(event: Event) -> None:
    """Print an event as text, at once, as whoever follows a log expects."""
    import sys

    say(plain_line(event))
    sys.stdout.flush()


def json_line(event: Event) -> None:
    """Print an event as one line of JSON."""
    import sys

    message, result = event.message, event.result
    print_json(
        {
            "event": event.kind,
            "cell": event.plan.cell.hash,
            "title": event.plan.cell.title,
            "target": event.plan.target,
            "iteration": None if message is None else standing(event)[0],
            "episodes": None if message is None else standing(event)[1],
            "headline": event.plan.cell.configuration.evaluation.headline,
            "value": None if message is None else message.headline,
            "activity": None if message is None else message.activity,
            "fraction": None if message is None else message.fraction,
            "seconds_left": event.seconds_left,
            "outcome": None if result is None or result.outcome is None else result.outcome.value,
            "cause": None if result is None else result.cause,
        }
    )
    sys.stdout.flush()
