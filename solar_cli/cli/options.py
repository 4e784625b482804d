"""The options that several commands share, each defined once, and how the shell completes them."""

from __future__ import annotations

from typing import Annotated

import typer

from solar_cli.errors import SolarError, UsageError


def complete_task(incomplete: str) -> list[str]:
    """Names of cards."""
    from solar_cli.settings import card_names

    return card_names()


def complete_method(incomplete: str) -> list[str]:
    """Names of methods, built in and installed."""
    from solar_cli.settings import method_names

    try:
        return method_names()
    except SolarError:  # a broken package must not spill into the command line being typed
        return []


def complete_variant(incomplete: str) -> list[str]:
    """Names of the variants of all cards."""
    from solar_cli.settings import card_names, load_card

    names = set()
    for task in card_names():
        try:
            names.update(load_card(task).variants)
        except SolarError:
            continue  # that card is reported when it is used
    return sorted(names)


def each_once(sets: list[str] | None) -> list[str] | None:
    """The assignments of ``--set``. Raises `UsageError` where two are of one setting."""
    if sets:
        from solar_cli.settings.card import assignment, leaves

        known: set[str] = set()
        for text in sets:
            paths = set(leaves(assignment(text)))
            if twice := known & paths:
                raise UsageError(f"--set {text!r}: {min(twice)} is set twice; keep one of them")
            known |= paths
    return sets


Database = Annotated[
    str | None,
    typer.Option(
        "--db",
        metavar="URL",
        help="Database: a file or a URL; else $SOLAR_DB, else runs/solar.db.",
        show_default=False,
    ),
]
Tasks = Annotated[
    list[str] | None,
    typer.Option(
        "--task",
        metavar="T",
        help="Only this task; repeats.",
        show_default=False,
        autocompletion=complete_task,
    ),
]
Methods = Annotated[
    list[str] | None,
    typer.Option(
        "--method",
        metavar="M",
        help="Only this method; repeats.",
        show_default=False,
        autocompletion=complete_method,
    ),
]
Variants = Annotated[
    list[str] | None,
    typer.Option(
        "--variant",
        metavar="V",
        help="Only this variant; repeats.",
        show_default=False,
        autocompletion=complete_variant,
    ),
]
Sets = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="PATH=TOML",
        help="Change one setting, by its path in the card; repeats.",
        show_default=False,
        callback=each_once,
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Output = Annotated[
    str | None,
    typer.Option("--output", metavar="FILE", help="Write there instead of to standard output."),
]
Force = Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")]
