"""``solar diagnose``: which part of a local method fails on a task."""

from __future__ import annotations

import os
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from solar_cli.cli.options import (
    AsJson,
    Database,
    Sets,
    complete_method,
    complete_task,
    complete_variant,
)
from solar_cli.cli.printing import complain, duration, number, print_json, print_table, say

if TYPE_CHECKING:
    from solar_cli.experiment.diagnosis import Finding
    from solar_cli.settings import Cell


def command(
    task: Annotated[
        str,
        typer.Option(metavar="T", help="A card's name or path.", autocompletion=complete_task),
    ],
    method: Annotated[
        str,
        typer.Option(metavar="M", help="A local method.", autocompletion=complete_method),
    ] = "solar",
    seed: Annotated[int, typer.Option(metavar="S", min=0, help="Of every run.")] = 0,
    variant: Annotated[
        str, typer.Option(metavar="V", help="Variant of the card.", autocompletion=complete_variant)
    ] = "default",
    sets: Sets = None,
    episodes: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Where to stop; else the card's desk budget."),
    ] = None,
    json: AsJson = False,
    db: Database = None,
) -> None:
    """Run a method again with one part known at a time: the true state, the simulator's dynamics,
    the true cost, all of these. What makes a difference is what fails.

    Nothing is stored. One seed is one seed: look at another before you believe it.

    \b
    Example:
      solar diagnose --task nav --method solar --seed 0
    """
    from solar_cli.cli.preflight import require_learners, require_tasks
    from solar_cli.cli.run import cells_of
    from solar_cli.cli.shadowing import tell_misspelt, tell_shadowed
    from solar_cli.experiment.engine import ENVIRONMENT

    tell_shadowed([task])
    tell_misspelt([task])
    [cell] = cells_of([task], [method], f"{seed}:{seed + 1}", variant, sets or (), None)
    # Before torch is imported: the same bits as a worker has.
    os.environ.update(ENVIRONMENT)

    from solar_cli.experiment.diagnosis import diagnose, local_learner
    from solar_cli.experiment.worker import prepare_torch

    local_learner(method)
    require_tasks([cell])
    require_learners([cell])
    target = episodes or cell.budget("desk")
    findings = []
    for finding in diagnose(cell, target, prepare_torch("auto")):
        findings.append(finding)
        complain(f"{finding.replaced}: {number(finding.level)}, {duration(finding.seconds)}")
    if json:
        print_json(_plain(cell, findings))
    else:
        _print(cell, findings)


def _plain(cell: Cell, findings: list[Finding]) -> dict[str, object]:
    evaluation = cell.configuration.evaluation
    return {
        "task": cell.task,
        "method": cell.method,
        "variant": cell.variant,
        "seed": cell.seed,
        "headline": evaluation.headline,
        "better": evaluation.better,
        "findings": [asdict(finding) for finding in findings],
    }


def _print(cell: Cell, findings: list[Finding]) -> None:
    evaluation = cell.configuration.evaluation
    unit = f" in {evaluation.unit}" if evaluation.unit else ""
    say(
        f"{cell.title}: {evaluation.headline}{unit} after {findings[0].episodes} episodes "
        f"({evaluation.better} is better)"
    )
    rows = [
        (
            finding.replaced,
            number(finding.level),
            number(finding.better_by) if finding is not findings[0] else "",
            "; ".join(finding.notes),
        )
        for finding in findings
    ]
    print_table(("replaced", f"{evaluation.headline}>", "better by>", "note"), rows)
