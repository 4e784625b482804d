"""Cards: TOML files in ``tasks/``, one a task, and how a card, a variant and ``--set`` combine.

Order, later wins: method defaults < card < variant < ``--set``.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from os.path import isfile
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from solar_cli.errors import UsageError, nearest
from solar_cli.settings.registry import BUILT_IN, method, method_names, settings_class
from solar_cli.settings.schema import Settings, converted, setting
from solar_cli.settings.task import EvaluationSettings, TaskSettings

PACKAGED = Path(__file__).parent.parent / "_tasks"
CHECKOUT = Path(__file__).parent.parent.parent / "tasks"
NAME = re.compile(r"[a-z0-9][a-z0-9_.-]*\Z")
NAMED = "lower-case letters, digits, '-', '_' and '.'"
Table = dict[str, Any]
S = TypeVar("S", bound=BaseModel)


class CardTables(Settings):
    """The top level of a card."""

    summary: str = setting(..., "one sentence: what must be done")
    task: TaskSettings = setting(..., "the control problem")
    evaluation: EvaluationSettings = setting(EvaluationSettings(), "how a policy is judged")
    methods: dict[str, Table] = setting({}, "what each method changes for this task")
    variants: dict[str, Table] = setting({}, "named overrides of this card")


@dataclass(frozen=True)
class Card:
    """One task as its file describes it."""

    name: str
    path: Path
    tables: Table
    """the file's content, before defaults"""

    @property
    def summary(self) -> str:
        """One sentence: what must be done."""
        return str(self.tables["summary"])

    @property
    def task(self) -> TaskSettings:
        """The task as the card's ``default`` variant has it."""
        return TaskSettings.model_validate(self.tables["task"])

    @property
    def evaluation(self) -> EvaluationSettings:
        """How the report reads this task."""
        return EvaluationSettings.model_validate(self.tables.get("evaluation", {}))

    @property
    def variants(self) -> list[str]:
        """``default`` and the variants that the card names."""
        return ["default", *sorted(self.tables.get("variants", {}))]


class Configuration(Settings):
    """Everything that one cell is told, resolved."""

    task: TaskSettings = setting(..., "the control problem")
    evaluation: EvaluationSettings = setting(..., "how a policy is judged")
    method: Settings = setting(..., "the method's settings")


@dataclass(frozen=True)
class Resolved:
    """A configuration and where each of its values comes from."""

    configuration: Configuration
    origins: dict[str, str]
    """dotted path -> ``card``, ``variant NAME`` or ``--set``; all others are defaults"""


def card_folders() -> list[Path]:
    """Where cards are looked for by name: ``./tasks`` first, then the package's own."""
    return [Path("tasks"), CHECKOUT if CHECKOUT.is_dir() else PACKAGED]


def card_names() -> list[str]:
    """Names of all cards that can be found."""
    return sorted({path.stem for folder in card_folders() for path in folder.glob("*.toml")})


def card_files(name: str) -> list[Path]:
    """The files of that card; the first one is read, and a folder is no card."""
    paths = [folder / f"{name}.toml" for folder in card_folders()]
    return [path for path in paths if isfile(path)]  # unlike is_file, also of a name too long


def load_card(name: str) -> Card:
    """Read the card at path ``name`` (ending in .toml) or of that name.

    Raises `UsageError` naming file, line or key, and what was expected.
    """
    if name.endswith(".toml"):
        return _read(Path(name))
    if files := card_files(name):
        return _read(files[0])
    raise UsageError(f"unknown task {name!r}: {nearest(name, card_names())}")


def _read(path: Path) -> Card:
    if not NAME.match(path.stem):
        raise UsageError(f"card {path}: a task's name has {NAMED} only; rename the file")
    tables = _toml(path)
    if "extends" in tables:
        tables = _extended(tables, path)
    card = Card(path.stem, path, tables)
    validated(CardTables, tables, f"card {path}")
    for variant in tables.get("variants", {}):
        # A report names files by it.
        if not NAME.match(variant) or variant == "default":
            raise UsageError(
                f"card {path}: 'variants.{variant}': a variant's name has {NAMED} only, and "
                "'default' is the card without any; rename it"
            )
    for variant in card.variants:
        for name in tables.get("methods", {}):
            # Methods of packages that are not installed here are left to those who have them, and
            # those that cannot learn from what this card shows to the card that it extends.
            known = name in method_names() and _learns_from(card, name)
            if known and _changes(card, variant, name):
                try:
                    resolve(card, name, variant)
                except UsageError as error:
                    place = "" if f"card {path}" in str(error) else f"card {path}: "
                    raise UsageError(f"{place}{error}") from error
    return card


def _toml(path: Path) -> Table:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"card {path}: not valid TOML: {error}; correct that line") from error
    except (OSError, UnicodeDecodeError, RecursionError) as error:
        raise UsageError(f"card {path}: cannot be read ({error}); name a readable file") from error


def _extended(tables: Table, path: Path) -> Table:
    """The card beside this one, or known by name, that ``extends`` names, with these laid over."""
    name = tables.pop("extends")
    folders = [path.parent, *card_folders()]
    bases = [folder / f"{name}.toml" for folder in folders] if isinstance(name, str) else []
    base = next((base for base in bases if isfile(base)), None)
    if base is None or name == path.stem:
        raise UsageError(
            f"card {path}: 'extends' must be the name of another card, not {name!r}: "
            f"{nearest(str(name), set(card_names()) - {path.stem})}"
        )
    whole = _toml(base)
    if "extends" in whole:
        raise UsageError(f"card {path}: {name!r} extends a card itself; extend that one instead")
    _merge(whole, tables)
    return whole


def resolve(
    card: Card, method_name: str, variant: str = "default", sets: Sequence[str] = ()
) -> Resolved:
    """Combine method defaults, card, variant and ``--set`` into one configuration.

    ``sets`` are ``PATH=TOML`` with the card's paths. Raises `UsageError` for an unknown name or
    path and for an ill-typed value, always naming the path.
    """
    entry = method(method_name)
    if variant not in card.variants:
        raise UsageError(
            f"task {card.name!r} has no variant {variant!r}: {nearest(variant, card.variants)}"
        )
    if not _changes(card, variant, method_name):
        raise UsageError(
            f"variant {variant!r} of task {card.name!r} changes nothing for {method_name!r}: "
            "leave --variant out"
        )
    overrides = _variant(card, variant)
    layers = [
        ("card", _with_method(card, card.tables, method_name)),
        (f"variant {variant}", _with_method(card, overrides, method_name, f"variants.{variant}.")),
    ]
    layers += [("--set", assignment(text)) for text in sets]
    merged: Table = {"method": _own_defaults(settings_class(entry))}
    origins: dict[str, str] = {}
    for origin, layer in layers:
        _check_methods(layer, origin, card)
        tree = {
            "task": layer.get("task", {}),
            "evaluation": layer.get("evaluation", {}),
            "method": layer.get("methods", {}).get(method_name, {}),
        }
        _merge(merged, deepcopy(tree))
        origins.update({path: origin for path in leaves(tree)})
    where = f"task {card.name!r}, method {method_name!r}, variant {variant!r}"
    configuration = Configuration.model_construct(
        task=validated(TaskSettings, merged["task"], where, "task"),
        evaluation=validated(EvaluationSettings, merged["evaluation"], where, "evaluation"),
        method=validated(settings_class(entry), merged["method"], where, f"methods.{method_name}"),
    )
    if configuration.task.observation.kind not in entry.observations:
        seen = configuration.task.observation.kind
        others = [other.name for other in BUILT_IN if seen in other.observations]
        raise UsageError(
            f"method {method_name!r} learns from {' or '.join(entry.observations)} observations, "
            f"task {card.name!r} gives {seen}: choose {', '.join(others[:-1])} or {others[-1]}"
        )
    return Resolved(configuration, origins)


def _own_defaults(settings: type[BaseModel]) -> Table:
    """What a method's class says of its nested settings, where it departs from their own defaults.

    Laid below the card, so that a card's table for some of them does not undo the rest.
    """
    return {
        name: field.default.model_dump(exclude_unset=True)
        for name, field in settings.model_fields.items()
        if isinstance(field.default, BaseModel) and field.default.model_fields_set
    }


def _learns_from(card: Card, method_name: str) -> bool:
    return card.task.observation.kind in method(method_name).observations


def _changes(card: Card, variant: str, method_name: str) -> bool:
    """Whether a variant says anything that concerns a method: a second name is no variant."""
    overrides = _variant(card, variant)
    shared = set(overrides) - {"methods"}
    return variant == "default" or bool(shared) or method_name in overrides.get("methods", {})


def _with_method(card: Card, layer: Table, method_name: str, place: str = "") -> Table:
    """The card's tables or a variant's; below a method's own what it is ``like`` another one's.

    It takes of the other what it has a setting for.
    """
    methods: Table = layer.get("methods", {})
    own = deepcopy(methods.get(method_name, {}))
    like = own.pop("like", None)
    if like is not None and (not isinstance(like, str) or like not in methods):
        raise UsageError(
            f"card {card.path}: {place}methods.{method_name}.like = {like!r}: "
            f"{nearest(str(like), set(methods) - {method_name})}"
        )
    others = methods[like] if like else {}
    taken = settings_class(method(method_name)).model_fields.keys() & others.keys()
    table = {key: deepcopy(others[key]) for key in others if key in taken}
    _merge(table, own)
    return {**layer, "methods": {**methods, method_name: table}}


def _variant(card: Card, variant: str) -> Table:
    overrides: Table = card.tables.get("variants", {}).get(variant, {})
    return overrides


def _check_methods(layer: Table, origin: str, card: Card) -> None:
    if origin == "card":
        return
    for key in layer:
        if key not in ("task", "evaluation", "methods"):
            raise UsageError(
                f"{origin} of task {card.name!r}: unknown path {key!r}: "
                "a path starts with task, evaluation or methods"
            )
    if not isinstance(named := layer.get("methods", {}), dict):
        raise UsageError(
            f"{origin} of task {card.name!r}: 'methods' takes no value: say methods.NAME.SETTING"
        )
    if origin == "--set":
        for name in named:
            method(name)


def assignment(text: str) -> Table:
    """``a.b=TOML`` as nested tables. Raises `UsageError` when it is not of that form."""
    path, separator, value = text.partition("=")
    if not separator or not all(part.strip() for part in path.split(".")):
        raise UsageError(f"--set {text!r}: expected PATH=VALUE, as in task.horizon=40")
    try:
        parsed = tomllib.loads(f"value = {value}")
        tree: Any = parsed.pop("value")
    except (ValueError, KeyError, RecursionError) as error:  # a number or a nesting without end
        raise UsageError(
            f"--set {text!r}: {value!r} is not a TOML value (text needs quotes): {error}"
        ) from error
    if parsed:
        raise UsageError(f"--set {text!r}: one value only; repeat --set for another")
    for part in reversed(path.split(".")):
        tree = {part.strip(): tree}
    return dict(tree)


def _merge(base: Table, over: Table) -> None:
    """Lay ``over`` onto ``base`` in place; tables merge, everything else is replaced."""
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            _merge(base[key], value)
        else:
            base[key] = value


def leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterable[str]:
    """The dotted path of each value in nested tables."""
    for key, value in tree.items():
        path = f"{prefix}{key}"
        if isinstance(value, dict):
            yield from leaves(value, f"{path}.")
        else:
            yield path


def validated(model: type[S], table: Any, where: str, path: str = "") -> S:
    """Validate, or say every mistake in one line: where, which key, what was expected.

    ``path`` is that of the table, which keys are named with.
    """
    try:
        made = model.model_validate(table)
    except ValidationError as error:
        mistakes = []
        faults = error.errors(include_url=False)
        for fault in faults:
            depth = len(fault["loc"])
            if fault["type"] == "too_short" and any(
                len(other["loc"]) > depth and other["loc"][:depth] == fault["loc"]
                for other in faults
            ):
                continue  # entries that are wrong were left out before they were counted
            key = ".".join([path] * bool(path) + [str(part) for part in fault["loc"]])
            if fault["type"] == "extra_forbidden":
                siblings = _siblings(model, fault["loc"])
                mistakes.append(f"unknown key {key!r} ({nearest(str(fault['loc'][-1]), siblings)})")
            else:
                given = "" if fault["type"] == "missing" else f", not {fault['input']!r}"
                table = fault["type"] in ("dict_type", "model_type")
                said = "Input should be a table" if table else fault["msg"]
                mistakes.append(f"{key!r}: {said}{given}")
        raise UsageError(f"{where}: {'; '.join(mistakes)}") from error
    mistakes = [
        f"{key!r}: Input should be {expected}, not {given!r}"
        for key, expected, given in converted(table, made, path)
    ]
    if mistakes:
        raise UsageError(f"{where}: {'; '.join(mistakes)}")
    return made


def _siblings(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """The keys that stand beside an unknown one."""
    for part in location[:-1]:
        field = model.model_fields.get(str(part))
        if field is None:  # a name that the user chose, in a table of tables
            continue
        inner = _models(field.annotation)
        if len(inner) != 1:
            return []
        model = inner[0]
    return [field.alias or name for name, field in model.model_fields.items()]


def _models(annotation: Any) -> list[type[BaseModel]]:
    """The models in a type such as ``dict[str, Model] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]
