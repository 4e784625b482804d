"""Cards, settings of methods, variants, the cell and its hash; nothing here imports torch."""

from solar_cli.settings.card import Card, Configuration, Resolved, card_names, load_card, resolve
from solar_cli.settings.cell import Cell, cells, parse_budget, parse_seeds, restore
from solar_cli.settings.registry import MethodEntry, load, method, method_names
from solar_cli.settings.task import EvaluationSettings, Observation, TaskSettings

__all__ = [
    "Card",
    "Cell",
    "Configuration",
    "EvaluationSettings",
    "MethodEntry",
    "Observation",
    "Resolved",
    "TaskSettings",
    "card_names",
    "cells",
    "load",
    "load_card",
    "method",
    "method_names",
    "parse_budget",
    "parse_seeds",
    "resolve",
    "restore",
]
