"""What ``solar run`` says of its matrix before and after."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from solar_cli.cli.printing import clean, duration, print_json, print_table, say
from solar_cli.experiment.estimates import Estimate
from solar_cli.experiment.matrix import Action, Plan
from solar_cli.experiment.scheduler import Result, default_workers
from solar_cli.store.records import Outcome
from solar_cli.wording import counted


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
        f"about {duration(sum(known) / min(at_once, len(work)))}"
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


def print_results(results: Sequence[Result], json: bool, db: str | None) -> None:
    """What was done, a table of causes where something is missing, and what to do next."""
    done = Counter(_kind(result) for result in results)
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
                (result.plan.cell.hash[:8], result.plan.cell.title, _kind(result), result.cause)
                for result in missing
            ],
            "Not finished",
        )
    say("next:")
    if any(_stopped(result) for result in results):
        say("  the same command again, which goes on from here")
    for command in next_commands(results, db):
        say(f"  {command}")


def _stopped(result: Result) -> bool:
    """Whether the cell is left as an interruption leaves it: begun, or still waiting."""
    return result.outcome is Outcome.INTERRUPTED or (result.outcome is None and result.plan.is_work)


def _kind(result: Result) -> str:
    """What became of a cell, in a word or two."""
    if result.outcome is not None:
        return result.outcome.value
    return {
        Action.SKIP: "finished already",
        Action.STALE: "stale (finished by other code)",
        Action.BLOCKED: "left alone",
    }.get(result.plan.action, "not started")


def next_commands(results: Sequence[Result], db: str | None) -> list[str]:
    """Commands that make sense now, ready to be copied."""
    import shlex

    where = "" if db is None else f" --db {shlex.quote(clean(db))}"
    missing = [result.plan.cell for result in results if not result.finished]
    done = [result.plan.cell for result in results if result.finished]
    commands = [f"solar show {missing[0].hash[:8]}{where}"] if missing else []
    if done:
        commands += [f"solar report{where}"]
        if len({(cell.method, cell.variant) for cell in done}) > 1:
            commands += [f"solar compare{where}"]
        commands += [f"solar show {done[0].hash[:8]}{where}"] if not missing else []
    return commands
