"""``solar tasks``: the cards, and what a card resolves to."""

from __future__ import annotations

from typing import Annotated

import typer

from solar_cli.cli.options import (
    AsJson,
    Database,
    Sets,
    complete_method,
    complete_task,
    complete_variant,
)
from solar_cli.cli.printing import print_json, print_table, say
from solar_cli.errors import UsageError


def command(
    name: Annotated[
        str | None,
        typer.Argument(help="A card's name, or its path.", autocompletion=complete_task),
    ] = None,
    method: Annotated[
        str, typer.Option(help="For this method.", autocompletion=complete_method)
    ] = "solar",
    variant: Annotated[
        str, typer.Option(help="In this variant.", autocompletion=complete_variant)
    ] = "default",
    sets: Sets = None,
    json: AsJson = False,
    db: Database = None,
) -> None:
    """List the tasks, or show every setting of one and where its value comes from.

    \b
    Example:
      solar tasks nav --method solar --variant smoke
    """
    from solar_cli.cli.shadowing import card_files, tell_misspelt, tell_shadowed
    from solar_cli.settings import card_names, load_card, resolve

    if name is not None:
        from solar_cli.cli.configuration import print_lines, resolved_lines

        tell_shadowed([name])
        tell_misspelt([name])
        print_lines(
            resolved_lines(resolve(load_card(name), method, variant, sets or ()), method), json
        )
        return
    cards, faults = [], {}
    found = [known for known in card_names() if card_files(known)]
    tell_shadowed(found)
    for known in found:
        try:
            cards.append(load_card(known))
        except UsageError as error:
            faults[known] = f"cannot be used: {error}"
    if json:
        print_json(
            [
                {
                    "task": card.name,
                    "summary": card.summary,
                    "observation": card.task.observation.kind,
                    "horizon": card.task.horizon,
                    "variants": card.variants,
                    "card": str(card.path),
                }
                for card in cards
            ]
            + [{"task": known, "error": fault} for known, fault in faults.items()]
        )
        return
    print_table(
        ("task", "what must be done", "observation", "horizon>", "variants", "card"),
        [
            (
                card.name,
                card.summary,
                " x ".join(map(str, card.task.observation.frame_shape)),
                card.task.horizon,
                ", ".join(card.variants),
                card.path,
            )
            for card in cards
        ],
    )
    for known, fault in faults.items():
        say(f"{known}: {fault}")
