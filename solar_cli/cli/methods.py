"""``solar methods``: the methods, and what can be set of one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from solar_cli.cli.options import AsJson, Database, complete_method
from solar_cli.cli.printing import complain, print_json, print_table, say
from solar_cli.errors import SolarError

if TYPE_CHECKING:
    from solar_cli.settings import MethodEntry
    from solar_cli.settings.extras import Extra


def command(
    name: Annotated[
        str | None, typer.Argument(help="A method's name.", autocompletion=complete_method)
    ] = None,
    json: AsJson = False,
    db: Database = None,
) -> None:
    """List the methods, built in and installed, or what one is and every setting with its default.

    \b
    Example:
      solar methods solar
    """
    from dataclasses import asdict

    from solar_cli.settings import method, method_names

    if name is not None:
        from solar_cli.cli.configuration import default_lines, print_lines

        entry = method(name)
        if not json:
            _say(entry)
        print_lines(default_lines(entry), json)
        return
    entries = []
    for known in method_names():
        try:
            entries.append(method(known))
        except SolarError as error:  # another package's, and the others are there all the same
            complain(f"solar: {error}")
    if json:
        print_json([{**asdict(entry), "extras": _on(entry)} for entry in entries])
        return
    print_table(
        ("method", "what it does", "source", "learns from", "needs", "extras on"),
        [
            (
                entry.name,
                entry.summary,
                entry.source,
                ", ".join(entry.observations),
                entry.needs,
                ", ".join(_on(entry)),
            )
            for entry in entries
        ],
    )


def _on(entry: MethodEntry) -> list[str]:
    """Extras that are on before any card."""
    return [extra.name for extra, value in _extras(entry) if extra.is_on(value)]


def _extras(entry: MethodEntry) -> list[tuple[Extra, Any]]:
    """Each of its extras, and the value of the setting before any card."""
    from solar_cli.cli.configuration import default_lines
    from solar_cli.settings.extras import extras_of

    prefix = f"methods.{entry.name}."
    values = {line.path.removeprefix(prefix): line.value for line in default_lines(entry)}
    return [(extra, values[extra.path]) for extra in extras_of(values)]


def _say(entry: MethodEntry) -> None:
    """What it is."""
    from solar_cli.cli.configuration import shown

    say(f"{entry.name}: {entry.summary}")
    say(f"source: {entry.source}")
    if entry.deviations:
        say(f"deviations: {entry.deviations}")
    say(f"learns from: {', '.join(entry.observations)}; needs: {entry.needs}")
    extras = _extras(entry)
    for title, on in (("extras on", True), ("off unless a card says so", False)):
        found = [
            f"{extra.name} ({extra.path} = {shown(value)})"
            for extra, value in extras
            if extra.is_on(value) == on
        ]
        if found:
            say(f"{title}: {'; '.join(found)}")
