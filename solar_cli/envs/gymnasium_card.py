"""What a card says under ``[task.parameters]`` where ``simulator = "gymnasium"``.

A cost and measures are made of an observation's entries: a Box read as a row of S numbers, each
known by its place, or by its name where the card gives ``names``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, model_validator

from solar_cli.errors import UsageError, nearest
from solar_cli.settings.schema import Settings, setting

Floats = NDArray[np.float64]
Entry = str | int
OWN_REWARD = "minus reward"


class Term(Settings):
    """A term of a cost: weight x (entry - target)^2."""

    weight: float = setting(..., "factor of the square", ge=0)
    target: float = setting(0.0, "where the entry should be")


class Measure(Settings):
    """Ground truth to judge a policy by: of an observation, or of what a step tells besides."""

    entry: Entry | None = setting(None, "an entry of the observation")
    norm: tuple[Entry, ...] = setting((), "length of the vector of these entries")
    minus: tuple[Entry, ...] = setting((), "entries to take away from those of norm first")
    info: str | None = setting(None, "a number of info; 0 until a reset or a step tells it")

    @model_validator(mode="after")
    def _one_of_three(self) -> Self:
        if (self.entry is not None) + bool(self.norm) + (self.info is not None) != 1:
            raise ValueError("give one of entry, norm and info")
        if len(self.minus) not in (0, len(self.norm)):
            raise ValueError("minus must have as many entries as norm")
        return self


def _table(value: Any) -> Any:
    if value == OWN_REWARD:
        return None
    if not isinstance(value, dict) or not value:
        raise ValueError(f"expected {OWN_REWARD!r}, or a table: ENTRY = {{ weight = 1.0 }}")
    return value


class Parameters(Settings):
    """All of them."""

    id: str = setting(..., "as gymnasium.make knows it, with its version")
    package: str | None = setting(None, "a package whose import registers it", alias="import")
    make: dict[str, Any] = setting({}, "further arguments of gymnasium.make")
    reset: dict[str, Any] = setting({}, "options of every reset")
    names: tuple[str, ...] = setting((), "of the observation's entries, in order")
    cost: Annotated[dict[str, Term] | None, BeforeValidator(_table)] = setting(
        OWN_REWARD,
        "of a step: minus its reward, which most environments give for the state after it; or a "
        "table of squares of entries, of the state before it",
        validate_default=True,
    )
    ended_cost: float | None = setting(
        None,
        "of each step after an early end; by default nothing where the cost is minus the reward, "
        "as in any return of Gymnasium's, else the cost of the state that the episode ended in",
    )
    measures: dict[str, Measure] = setting({}, "by name")

    @property
    def reads_entries(self) -> bool:
        """Whether the observation must be a row of numbers, even if a learner sees pictures."""
        return bool(self.names or self.cost or any(m.info is None for m in self.measures.values()))


class Entries:
    """The entries of an observation, as the card refers to them."""

    def __init__(self, parameters: Parameters, size: int) -> None:
        if len(parameters.names) not in (0, size):
            raise UsageError(
                f"task.parameters.names: {len(parameters.names)} names for the {size} entries that "
                f"an observation of {parameters.id} has: give one an entry, or none"
            )
        self.size = size
        self._places = {name: place for place, name in enumerate(parameters.names)}

    def place(self, entry: Entry, where: str) -> int:
        """Which number an entry is. Raises `UsageError`, saying ``where`` the card refers to it."""
        if entry in self._places:
            return self._places[str(entry)]
        text = str(entry)
        if text.isdecimal() and int(text) < self.size:
            return int(text)
        known = f"0 to {self.size - 1}"
        hint = nearest(text, self._places) if self._places else f"they are {known}"
        raise UsageError(f"task.parameters.{where}: no entry {entry!r} in an observation: {hint}")

    def places(self, entries: Sequence[Entry], where: str) -> list[int]:
        """`place` of several."""
        return [self.place(entry, where) for entry in entries]


class SquaredCost:
    """The sum of a cost's terms, and alpha |a|^2."""

    def __init__(self, terms: dict[str, Term], entries: Entries, action_cost: float) -> None:
        self._terms = [(entries.place(name, f"cost.{name}"), term) for name, term in terms.items()]
        self._action_cost = action_cost

    def __call__(self, observed: Any, action: Any) -> Any:
        """Costs (...) of entries (..., S) and actions (..., a) in the card's units."""
        cost = self._action_cost * (action * action).sum(-1)
        for place, term in self._terms:
            apart = observed[..., place] - term.target
            cost = cost + term.weight * apart * apart
        return cost


class Gauge:
    """One measure, read off entries (S,) and an info."""

    def __init__(self, name: str, measure: Measure, entries: Entries | None) -> None:
        self.info, where = measure.info, f"measures.{name}"
        self._places, self._minus = [], []
        self._signed = measure.entry is not None
        if entries is not None:
            named = measure.norm if measure.entry is None else (measure.entry,)
            self._places = entries.places(named, where)
            self._minus = entries.places(measure.minus, where)

    def __call__(self, observed: Floats, info: dict[str, Any]) -> float:
        """Its value now."""
        if self.info is not None:
            return float(info.get(self.info, 0.0))
        vector = observed[self._places]
        if self._minus:
            vector = vector - observed[self._minus]
        return float(vector[0]) if self._signed else math.sqrt(vector @ vector)
