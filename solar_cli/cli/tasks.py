"""``solar tasks``: the cards, and what a card resolves to."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from solar_cli.cli.options import (
    AsJson,
    Database,
    Force,
    Sets,
    complete_method,
    complete_task,
    complete_variant,
)
from solar_cli.cli.printing import deliver, print_json, print_table, require_free, say
from solar_cli.errors import UsageError
from solar_cli.wording import counted

if TYPE_CHECKING:
    from solar_cli.settings import TaskSettings


def command(
    name: Annotated[
        str | None,
        typer.Argument(help="A card's name, or its path.", autocompletion=complete_task),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="For this method; else solar, or the card's first.",
            show_default=False,
            autocompletion=complete_method,
        ),
    ] = None,
    variant: Annotated[
        str, typer.Option(help="In this variant.", autocompletion=complete_variant)
    ] = "default",
    sets: Sets = None,
    preview: Annotated[
        str | None,
        typer.Option(metavar="FILE.gif", help="Draw an episode of exploration noise, instead."),
    ] = None,
    force: Force = False,
    json: AsJson = False,
    db: Database = None,
) -> None:
    """List the tasks, or show every setting of one and where its value comes from. With --preview
    draw one instead: what a learner sees, and what people do.

    \b
    Example:
      solar tasks nav --method solar --variant smoke
    """
    from solar_cli.cli.shadowing import tell_misspelt, tell_shadowed
    from solar_cli.settings import card_names, load_card, resolve
    from solar_cli.settings.card import card_files

    if preview is not None:
        _require_gif(name, preview, force)
    if name is not None:
        from solar_cli.cli.configuration import print_lines, resolved_lines

        tell_shadowed([name])
        tell_misspelt([name])
        card = load_card(name)
        told = card.tables.get("methods", {})
        method = method or ("solar" if "solar" in told else next(iter(told), "solar"))
        resolved = resolve(card, method, variant, sets or ())
        if preview is None:
            print_lines(resolved_lines(resolved, method), json)
        else:
            _draw(name, resolved.configuration.task, preview, force, json)
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


def _require_gif(name: str | None, preview: str, force: bool) -> None:
    """Raise `UsageError` for a file that no preview can be written to, before anything runs."""
    if name is None:
        raise UsageError(f"--preview {preview}: of which task? solar tasks NAME --preview FILE.gif")
    if Path(preview).suffix.lower() != ".gif":
        raise UsageError(f"--preview {preview}: animations are GIFs; name a file FILE.gif")
    require_free("--preview", preview, force)


def _draw(name: str, task: TaskSettings, preview: str, force: bool, json: bool) -> None:
    """Run an episode of the task, and write its animation."""
    from solar_cli.experiment.preview import first_episode
    from solar_cli.reporting import animation

    drawn = _drawable(name, task)
    episode = first_episode(drawn)
    steps = int(episode.lengths[0])
    shown = animation.preview(task, drawn, episode.frames[0, : steps + 1])
    deliver(shown.gif, preview, force, "--preview")
    if json:
        print_json({"task": name, "preview": preview, "steps": steps, "caption": shown.caption})
        return
    early = f", which ended it before {task.horizon}" if steps < task.horizon else ""
    say(f"{name}: {counted(steps, 'step')} of exploration noise{early}; {shown.caption}")


def _drawable(name: str, task: TaskSettings) -> TaskSettings:
    """The task, seen as images. Raises `UsageError` where there are none."""
    from solar_cli.envs import build_task, drawable

    if task.observation.kind == "state":
        build_task(task)  # what is wrong with the card is told as it is
    try:
        return drawable(task)
    except UsageError as error:
        raise UsageError(
            f"--preview: there is nothing to draw of {name}, which can be learned all the same: "
            f"{error}"
        ) from error
