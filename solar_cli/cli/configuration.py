"""A resolved configuration, one line a setting, with where each value comes from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import BaseModel
from pydantic_core import to_jsonable_python

from solar_cli.cli.printing import print_json, print_table
from solar_cli.settings import Cell, Configuration, MethodEntry, Resolved, load_card, resolve
from solar_cli.settings.registry import settings_class
from solar_cli.settings.schema import source_of


@dataclass(frozen=True)
class Line:
    """One setting."""

    path: str
    """as ``--set`` takes it"""
    value: Any
    """as JSON data"""
    origin: str
    """``default``, ``card``, ``variant NAME`` or ``--set``"""
    source: str
    """where the default comes from: the paper's section, or ``ours``"""
    description: str


def settings_lines(
    kind: type[BaseModel],
    values: BaseModel | None,
    prefix: str,
    origins: Mapping[str, str] | None = None,
    inner: str = "",
) -> Iterator[Line]:
    """The settings of class ``kind`` below ``prefix``, with ``values`` or else the defaults.

    ``origins`` are those of `Resolved`, which names the place ``inner``.
    """
    dumped = {} if values is None else values.model_dump(mode="json")
    for name, field in kind.model_fields.items():
        path, below = f"{prefix}.{name}", f"{inner}.{name}"
        value = field.get_default() if values is None else getattr(values, name)
        annotation = field.annotation
        if isinstance(value, BaseModel):
            yield from settings_lines(type(value), value, path, origins, below)
        elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield from settings_lines(annotation, None, path, origins, below)
        else:
            description, source = source_of(kind, (name,))
            required = values is None and field.is_required()
            given = (
                dumped[name]
                if values is not None
                else None
                if required
                else to_jsonable_python(value)
            )
            origin = "set by the card" if required else _origin(below, origins or {})
            yield Line(path, given, origin, source, description)


def _origin(path: str, origins: Mapping[str, str]) -> str:
    """Whoever set the value at ``path``, or, of a table, the last to set a part of it."""
    if path in origins:
        return origins[path]
    parts = [origin for key, origin in origins.items() if key.startswith(f"{path}.")]
    return parts[-1] if parts else "default"


def default_lines(entry: MethodEntry) -> list[Line]:
    """Every setting of a method, before any card."""
    return list(settings_lines(settings_class(entry), None, f"methods.{entry.name}"))


def configuration_lines(
    configuration: Configuration, method_name: str, origins: Mapping[str, str]
) -> list[Line]:
    """Every setting of a cell, in the card's order."""
    return [
        line
        for values, prefix, inner in (
            (configuration.task, "task", "task"),
            (configuration.evaluation, "evaluation", "evaluation"),
            (configuration.method, f"methods.{method_name}", "method"),
        )
        for line in settings_lines(type(values), values, prefix, origins, inner)
    ]


def resolved_lines(resolved: Resolved, method_name: str) -> list[Line]:
    """Every setting of a resolved card."""
    return configuration_lines(resolved.configuration, method_name, resolved.origins)


def changed_lines(cell: Cell) -> list[Line]:
    """What a stored cell has different from the defaults.

    The origin is what the card says today where it gives the same value, else the cell's own.
    """
    card = load_card(cell.task)
    known = cell.variant in card.variants
    resolved = resolve(card, cell.method, cell.variant if known else "default")
    today = {line.path: line for line in resolved_lines(resolved, cell.method)}
    own = "an earlier card" if known else f"variant {cell.variant}"
    lines = []
    for line in configuration_lines(cell.configuration, cell.method, {}):
        current = today[line.path]
        same = current.value == line.value
        if not same or current.origin != "default":
            origin = current.origin if same else own
            lines.append(Line(line.path, line.value, origin, line.source, line.description))
    return lines


def print_lines(lines: list[Line], json: bool) -> None:
    """A table, or JSON."""
    if json:
        print_json([asdict(line) for line in lines])
        return
    rows = [
        (
            line.path,
            shown(line.value),
            f"default ({line.source})" if line.origin == "default" else line.origin,
            line.description,
        )
        for line in lines
    ]
    print_table(("setting", "value", "from", "meaning"), rows)


def shown(value: Any) -> str:
    """A value in TOML's manner."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        inside = ", ".join(f"{key} = {shown(entry)}" for key, entry in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, list):
        return f"[{', '.join(shown(entry) for entry in value)}]"
    return f'"{value}"' if isinstance(value, str) else str(value)
