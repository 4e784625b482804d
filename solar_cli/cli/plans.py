"""What ``solar run`` says of its matrix before and after."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from solar_cli.cli.printing import clean, duration, print_json, print_table, say
from solar_cli.experiment.estimates import Estimate
from solar_cli.experiment.matrix import Action, Plan
from solar_cli.experiment.scheduler import STOPPED, Result, default_workers
from solar_cli.store.records import Outcome, State
from solar_cli.wording import counted, without_password


def planned(plan: Plan) -> dict[str, Any]:
    """A plan as JSON data."""
    cell = plan.cell
    return {
        "cell": cell.hash,
        "task": cell.task,
        "method": cell.method,
        "variant": cell.variant,
        "seed": cell.seed,
        "target": plan.target,
        "action": plan.action.value,
        "why": plan.why,
    }


def print_plans(plans: Sequence[Plan], json: bool) -> None:
    """One line a cell: what is done with it, and why."""
    if json:
        print_json({"event": "plan", "cells": [planned(plan) for plan in plans]})
        return
    for plan in plans:
        say(f"{plan.action.value:<8} {plan.cell.title} ({plan.cell.hash[:8]}): {plan.why}")


def print_estimates(
    plans: Sequence[Plan], estimates: Sequence[Estimate], workers: int | None, json: bool
) -> None:
    """One row a cell: what would be done, and what it would take."""
    pairs = list(zip(plans, estimates, strict=True))
    if json:
        print_json(
            [
                {
                    **planned(plan),
                    "seconds": estimate.seconds,
                    "memory_bytes": estimate.memory_bytes,
                    "disk_bytes": estimate.disk_bytes,
                }
                for plan, estimate in pairs
            ]
        )
        return
    rows = [
        (
            plan.cell.hash[:8],
            plan.cell.title,
            plan.action.value,
            plan.target,
            "unknown" if estimate.seconds is None else duration(estimate.seconds),
            mebibytes(estimate.memory_bytes),
            mebibytes(estimate.disk_bytes),
            plan.why,
        )
        for plan, estimate in pairs
    ]
    columns = ("cell", "title", "action", "episodes>", "time>", "memory>", "disk>", "why")
    print_table(columns, rows)
    work = [estimate for plan, estimate in pairs if plan.is_work]
    at_once = workers or default_workers(len(work))
    known = [estimate.seconds for estimate in work if estimate.seconds is not None]
    time = (
        f"about {duration(max(*known, sum(known) / min(at_once, len(work))))}"
        if work and len(known) == len(work)
        else "a time that is unknown until one such cell has finished"
    )
    say(
        f"{len(work)} of {counted(len(plans), 'cell')} to compute, {at_once} at a time: {time}; "
        "nothing was started"
        if work
        else f"{counted(len(plans), 'cell')} and nothing to compute; nothing was started"
    )


def mebibytes(size: int | None) -> str:
    """A size in MiB."""
    return "unknown" if size is None else f"{size / 2**20:.0f} MiB"


def print_results(
    results: Sequence[Result], json: bool, db: str | None, *, redo: bool = False
) -> None:
    """What was done, a table of causes where something is missing, and what to do next.

    ``redo`` is whether the command said so.
    """
    done = Counter(kind(result) for result in results)
    missing = [result for result in results if not result.finished]
    if json:
        print_json(
            {
                "event": "summary",
                "finished": all(result.finished for result in results),
                "counts": dict(done),
                "cells": [
                    {
                        **planned(result.plan),
                        "finished": result.finished,
                        "outcome": None if result.outcome is None else result.outcome.value,
                        "cause": result.cause,
                    }
                    for result in results
                ],
            }
        )
        return
    say()
    say(", ".join(f"{count} {kind}" for kind, count in done.items()))
    for result in results:
        if result.finished and result.outcome is not None and result.cause:
            say(f"note on {result.plan.cell.title}: {result.cause}")
    if missing:
        print_table(
            ("cell", "title", "outcome", "cause"),
            [
                (result.plan.cell.hash[:8], result.plan.cell.title, kind(result), result.cause)
                for result in missing
            ],
            "Not finished",
        )
    say("next:")
    for line in [*next_steps(results, redo), *next_commands(results, db)]:
        say(f"  {line}")


def next_steps(results: Sequence[Result], redo: bool) -> list[str]:
    """How to get what is missing."""
    stopped = [result for result in results if _stopped(result)]
    again = {result.plan.cell.seed for result in stopped if result.outcome is None and redo}
    left = [result.plan.record for result in results if result.plan.action is Action.BLOCKED]
    states = {record.state for record in left if record is not None}
    ends = {result.outcome for result in results}
    steps = []
    if stopped:
        when = "" if all(map(_by_request, stopped)) else "once the cause is put right, "
        how = (
            "without --redo, which goes on with what was begun" if redo else "again, which goes on"
        )
        steps += [f"{when}the same command {how} from here"]
    if again:  # the same seeds would discard again what was begun
        seeds = ",".join(map(str, sorted(again)))
        one = "," * (len(again) == 1)  # a number alone is how many
        steps += [f"for what was not started, the same command with --seeds {seeds}{one}"]
    if State.RUNNING in states:
        steps += ["the same command again, once the other run has ended"]
    if (ends | states) & {Outcome.FAILED, Outcome.DIVERGED, State.FAILED, State.DIVERGED}:
        steps += ["--retry takes up what failed or diverged, once the cause is put right"]
    return steps


def _stopped(result: Result) -> bool:
    """Whether the cell is left as an interruption leaves it: begun, or still waiting."""
    return result.outcome is Outcome.INTERRUPTED or (result.outcome is None and result.plan.is_work)


def _by_request(result: Result) -> bool:
    """Whether somebody stopped the cell; else it was something, such as a full disk."""
    return result.cause.startswith(("stopped", "the worker was ended", STOPPED))


def kind(result: Result) -> str:
    """What became of a cell, in a word or two."""
    if result.outcome is not None:
        return result.outcome.value
    return {
        Action.SKIP: "finished already",
        Action.STALE: "stale (finished by other code)",
        Action.BLOCKED: "left alone",
    }.get(result.plan.action, "not started")


def next_commands(results: Sequence[Result], db: str | None) -> list[str]:
    """Commands that make sense now, ready to be copied but for a password."""
    import shlex

    where = "" if db is None else f" --db {shlex.quote(clean(without_password(db)))}"
    missing = [result.plan.cell for result in results if not result.finished]
    done = [result.plan.cell for result in results if result.finished]
    commands = [f"solar show {missing[0].hash[:8]}{where}"] if missing else []
    if done:
        commands += [f"solar report{where}"]
        if len({(cell.method, cell.variant) for cell in done}) > 1:
            commands += [f"solar compare{where}"]
        commands += [f"solar show {done[0].hash[:8]}{where}"] if not missing else []
    return commands
