"""What all settings share: frozen, unknown keys refused, a description and a source for each field.

The hash of a cell is made of every field, but for two kinds, marked where they are declared:

* ``presentation``: shapes a report, never a number that is stored;
* ``added``: came after the first release. At the value that old runs had in effect it is left out,
  so that old cells keep their hash.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

OURS = "ours"
"""Source of a value that the paper does not give or that we chose otherwise."""
MOST_EPISODES = 10**9
"""of one cell: what every database can count"""


class Settings(BaseModel):
    """Base of all settings."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def setting(
    default: Any,
    description: str,
    source: str = OURS,
    *,
    presentation: bool = False,
    added: Any = ...,
    **constraints: Any,
) -> Any:
    """Declare one setting; pass ``...`` as the default of a required one.

    ``added`` is the value that a run made before this setting existed had in effect.
    """
    extra: dict[str, Any] = {"source": source, "presentation": presentation}
    if added is not ...:
        extra["added"] = added
    return Field(default, description=description, json_schema_extra=extra, **constraints)


def _extra(field: FieldInfo) -> dict[str, Any]:
    return field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}


def hashed_values(settings: BaseModel) -> dict[str, Any]:
    """The part of ``settings`` that can change a stored number, as plain JSON data."""
    values: dict[str, Any] = {}
    dumped = settings.model_dump(mode="json")
    for name, field in type(settings).model_fields.items():
        extra = _extra(field)
        if extra.get("presentation"):
            continue
        value = getattr(settings, name)
        if "added" in extra and dumped[name] == extra["added"]:
            continue
        values[name] = hashed_values(value) if isinstance(value, BaseModel) else dumped[name]
    return values


def completed(settings: type[BaseModel], stored: dict[str, Any]) -> dict[str, Any]:
    """Stored values, with settings that came later at the value that old runs had in effect."""
    values = dict(stored)
    for name, field in settings.model_fields.items():
        extra, inner = _extra(field), field.annotation
        if name not in values and "added" in extra:
            values[name] = extra["added"]
        elif isinstance(inner, type) and issubclass(inner, BaseModel) and name in values:
            values[name] = completed(inner, values[name])
    return values


def converted(given: Any, checked: Any, path: str = "") -> Iterator[tuple[str, str, Any]]:
    """(path, kind expected, value given) of what pydantic made a number or a truth value of.

    ``true`` for 1, ``"3"`` for 3 and 1 for ``true`` are slips of the pen, not ways to say it.
    """
    if isinstance(given, Mapping):
        for name, value in given.items():
            known = isinstance(checked, Mapping)
            inner = checked.get(name) if known else getattr(checked, name, None)
            yield from converted(value, inner, f"{path}.{name}" if path else name)
    elif isinstance(given, list) and isinstance(checked, list | tuple):
        for index, (value, inner) in enumerate(zip(given, checked, strict=False)):
            yield from converted(value, inner, f"{path}.{index}")
    elif isinstance(checked, int | float):
        expected = "true or false" if isinstance(checked, bool) else "a number"
        same = isinstance(given, bool) == isinstance(checked, bool)
        if not (same and isinstance(given, int | float)):
            yield path, expected, given


def source_of(settings: type[BaseModel], path: tuple[str, ...]) -> tuple[str, str]:
    """Description and source of the field at ``path`` below a settings class."""
    field = settings.model_fields[path[0]]
    inner = field.annotation
    if len(path) > 1 and isinstance(inner, type) and issubclass(inner, BaseModel):
        return source_of(inner, path[1:])
    return field.description or "", str(_extra(field).get("source", ""))
