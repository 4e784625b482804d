"""``solar run``: compute the cells of a matrix that are not finished yet."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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
from solar_cli.cli.preflight import Device
from solar_cli.errors import UsageError

if TYPE_CHECKING:
    from solar_cli.settings import Cell
    from solar_cli.store.store import Store


def command(
    tasks: Annotated[
        list[str],
        typer.Option(
            "--task",
            metavar="T",
            help="A card's name or path; repeats.",
            autocompletion=complete_task,
        ),
    ],
    methods: Annotated[
        list[str],
        typer.Option(
            "--method",
            metavar="M",
            help="A method's name; repeats.",
            autocompletion=complete_method,
        ),
    ],
    seeds: Annotated[
        str, typer.Option("--seeds", metavar="N", help="3 is 0, 1, 2; or 3,5,8; or 0:10.")
    ] = "1",
    variant: Annotated[
        str, typer.Option(metavar="V", help="Variant of the card.", autocompletion=complete_variant)
    ] = "default",
    sets: Sets = None,
    label: Annotated[
        str | None, typer.Option(metavar="L", help="Name of the variant that --set makes.")
    ] = None,
    budget: Annotated[
        str,
        typer.Option(
            metavar="desk|full|N", help="Episodes to stop at, with the iteration that reaches them."
        ),
    ] = "desk",
    workers: Annotated[
        int | None,
        typer.Option(metavar="W", min=1, help="Cells at a time; else what cores and memory allow."),
    ] = None,
    device: Annotated[Device, typer.Option(help="Where tensors live.")] = Device.AUTO,
    redo: Annotated[
        bool, typer.Option("--redo", help="Discard what is stored; begin anew.")
    ] = False,
    retry: Annotated[
        bool, typer.Option("--retry", help="Take up failed and diverged cells again.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done, and what it takes.")
    ] = False,
    json: AsJson = False,
    db: Database = None,
) -> None:
    """Compute every task x method x seed that is not finished; resume what was interrupted.

    Finished cells are skipped, or continued where more episodes are asked for.

    Ctrl-C saves and stops; the same command goes on from there.

    \b
    Example:
      solar run --task nav --method solar --seeds 1 --variant smoke
    """
    from solar_cli.cli.plans import print_estimates, print_plans, print_results
    from solar_cli.cli.preflight import (
        require_device,
        require_free_label,
        require_learners,
        require_memory,
        require_tasks,
    )
    from solar_cli.cli.shadowing import tell_misspelt, tell_shadowed
    from solar_cli.experiment.matrix import plan
    from solar_cli.settings import parse_budget

    tell_shadowed(tasks)
    tell_misspelt(tasks)
    matrix = cells_of(tasks, methods, seeds, variant, sets or (), label)
    wanted = parse_budget(budget)
    with planning_store(db) if dry_run else _store(db) as store:
        plans = plan(store, matrix, wanted, redo=redo, retry=retry)
        work = [planned.cell for planned in plans if planned.is_work]
        require_free_label(store, work, label)
        if work:
            require_memory(work)
            require_tasks(work)
        if dry_run:
            from solar_cli.experiment.estimates import estimate

            print_estimates(plans, estimate(store, plans), workers, json)
            return
        if work:
            require_device(device)
            require_learners(work)
        print_plans(plans, json)

        from solar_cli.cli.progress import watching
        from solar_cli.experiment.scheduler import run

        with watching(json, len(work)) as report:
            results = run(plans, store, workers=workers, report=report, device=device.value)
    print_results(results, json, db, redo=redo)
    if not all(result.finished for result in results):
        raise typer.Exit(1)


def cells_of(
    tasks: Sequence[str],
    methods: Sequence[str],
    seeds: str,
    variant: str,
    sets: Sequence[str],
    label: str | None,
) -> list[Cell]:
    """Every task x method x seed, each once.

    Raises `UsageError` for a name, a seed or a ``--set`` that is wrong or without effect.
    """
    from solar_cli.settings import cells, load_card, parse_seeds
    from solar_cli.settings.card import assignment

    numbers = parse_seeds(seeds)
    found = [
        cell
        for task in tasks
        for method in methods
        for cell in cells(load_card(task), method, numbers, variant, sets, label)
    ]
    for text in sets:
        for name in assignment(text).get("methods", {}):
            if name not in methods:
                raise UsageError(f"--set {text!r}: this run has no method {name!r}; correct either")
    return list({cell.hash: cell for cell in found}.values())


def _store(db: str | None) -> Store:
    from solar_cli.store.store import Store

    return Store.open(db)


@contextmanager
def planning_store(db: str | None) -> Iterator[Store]:
    """The database to plan with; an empty one where there is none yet, so that none is made."""
    from solar_cli.store.address import locate
    from solar_cli.store.store import Store

    if locate(db).is_new:
        with tempfile.TemporaryDirectory() as folder, Store.open(f"{folder}/solar.db") as store:
            yield store
    else:
        with Store.open(db, read_only=True) as store:
            yield store
