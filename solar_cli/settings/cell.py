"""The cell: task x method x variant x seed with its configuration, named by a hash of it."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from solar_cli.errors import UsageError
from solar_cli.settings.card import NAME, Card, Configuration, resolve
from solar_cli.settings.registry import method, settings_class
from solar_cli.settings.schema import MOST_EPISODES, completed, hashed_values
from solar_cli.settings.task import EvaluationSettings, TaskSettings

LONGEST_NAME = 60  # of a variant: it names files of a report and columns of a table
MOST_SEEDS = 10_000
"""of one run: beyond any experiment, and a slip of the pen must not fill the memory"""


@dataclass(frozen=True)
class Cell:
    """What one run computes."""

    task: str
    method: str
    variant: str
    seed: int
    configuration: Configuration

    @cached_property
    def hash(self) -> str:
        """Sixteen hexadecimal digits, of whatever can change a number that is stored.

        The stopping point is not in it: asking for more episodes continues the same cell.
        """
        identity = {
            "task": self.task,
            "method": self.method,
            "variant": self.variant,
            "seed": self.seed,
            "configuration": {
                "task": hashed_values(self.configuration.task),
                "evaluation": hashed_values(self.configuration.evaluation),
                "method": hashed_values(self.configuration.method),
            },
        }
        text = json.dumps(identity, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def title(self) -> str:
        """As a person names it: ``nav/solar seed 3``, with the variant where it is not default."""
        variant = "" if self.variant == "default" else f":{self.variant}"
        return f"{self.task}/{self.method}{variant} seed {self.seed}"

    def budget(self, wanted: Literal["desk", "full"] | int) -> int:
        """Episodes to stop at."""
        if isinstance(wanted, int):
            return wanted
        episodes: int = getattr(self.configuration.method.budget, wanted)  # type: ignore[attr-defined]
        return episodes

    def config(self) -> dict[str, Any]:
        """The whole configuration as plain JSON data, to be stored."""
        parts = self.configuration
        return {
            "task": parts.task.model_dump(mode="json"),
            "evaluation": parts.evaluation.model_dump(mode="json"),
            "method": parts.method.model_dump(mode="json"),
        }


def restore(task: str, method_name: str, variant: str, seed: int, config: dict[str, Any]) -> Cell:
    """The cell of a stored configuration; settings that came later are as they were in effect."""
    learner = settings_class(method(method_name))
    configuration = Configuration.model_construct(
        task=TaskSettings.model_validate(completed(TaskSettings, config["task"])),
        evaluation=EvaluationSettings.model_validate(
            completed(EvaluationSettings, config["evaluation"])
        ),
        method=learner.model_validate(completed(learner, config["method"])),
    )
    return Cell(task, method_name, variant, seed, configuration)


def cells(
    card: Card,
    method_name: str,
    seeds: Sequence[int],
    variant: str = "default",
    sets: Sequence[str] = (),
    label: str | None = None,
) -> list[Cell]:
    """The cells of one task and method, one a seed; a change of another method changes nothing."""
    configuration = resolve(card, method_name, variant, sets).configuration
    if label in card.variants:
        raise UsageError(
            f"--label {label!r} is a variant of task {card.name!r} already: choose another label"
        )
    own = [text for text in sets if _concerns(text, method_name)]
    name = variant_name(variant, own, label if own or not sets else None)
    return [Cell(card.name, method_name, name, seed, configuration) for seed in seeds]


def variant_name(variant: str, sets: Sequence[str], label: str | None) -> str:
    """The name of a variant made by ``--set``: its label, or what it changes."""
    if label is not None:
        if not NAME.match(label) or len(label) > LONGEST_NAME or label == "default":
            raise UsageError(
                f"--label {label!r}: use at most {LONGEST_NAME} lower-case letters, digits, '-', "
                "'_' and '.'"
            )
        return label
    if not sets:
        return variant
    changes = []
    for text in sorted(sets):
        path, _, value = text.partition("=")
        # The whole path but for where it starts: two settings of one name are two variants.
        key = re.sub(r"^\s*(task|methods\.[^.]+)\.", "", path)
        changes.append("-".join(_plain(part) for part in (key, value)))
    name = "_".join([variant] * (variant != "default") + changes)
    if len(name) <= LONGEST_NAME:
        return name
    digest = hashlib.sha256(name.encode()).hexdigest()[:8]
    return f"{name[: LONGEST_NAME - 9]}_{digest}"


def _plain(text: str) -> str:
    """In the letters that a name may have; a minus stays, as 1 and -1 differ."""
    return re.sub("[^a-z0-9.-]+", "_", text.lower()).strip("_")


def _concerns(text: str, method_name: str) -> bool:
    """Whether a ``--set`` can change this method's cells."""
    first, _, rest = text.partition("=")[0].partition(".")
    return first.strip() != "methods" or rest.partition(".")[0].strip() == method_name


def parse_seeds(text: str) -> list[int]:
    """``3`` is 0, 1, 2; ``3,5,8`` are those and ``5,`` is 5; ``0:10`` is 0 to 9."""
    try:
        if ":" in text:
            first, last = (int(part) for part in text.split(":"))
            seeds = list(range(first, min(last, first + MOST_SEEDS + 1)))
        elif "," in text:
            seeds = [int(part) for part in text.strip().removesuffix(",").split(",")]
        else:
            seeds = list(range(min(int(text), MOST_SEEDS + 1)))
    except ValueError as error:
        raise UsageError(
            f"--seeds {text!r}: expected a number of seeds (3), a list (3,5,8) or a range (0:10)"
        ) from error
    if len(seeds) > MOST_SEEDS:
        raise UsageError(f"--seeds {text!r}: expected at most {MOST_SEEDS} seeds")
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds) or max(seeds) >= 2**31:
        raise UsageError(
            f"--seeds {text!r}: expected at least one seed, each once, 0 to {2**31 - 1}"
        )
    return seeds


def parse_budget(text: str) -> Literal["desk", "full"] | int:
    """``desk``, ``full`` or a number of episodes."""
    if text == "desk":
        return "desk"
    if text == "full":
        return "full"
    # Its length first: Python refuses to read a number of thousands of digits.
    known = text.isdecimal() and len(text) <= 2 * len(str(MOST_EPISODES))
    if not known or not 0 < int(text) <= MOST_EPISODES:
        raise UsageError(
            f"--budget {text!r}: expected desk, full or a number of episodes from 1 to "
            f"{MOST_EPISODES}"
        )
    return int(text)
