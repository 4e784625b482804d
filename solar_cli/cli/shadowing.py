"""What is odd about cards, though not wrong: one line on standard error."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from os.path import isfile
from pathlib import Path

from solar_cli.cli.printing import complain
from solar_cli.settings import load_card, method_names
from solar_cli.settings.card import card_files, card_folders

SLIP = 0.75
"""likeness from which on a name is a slip of the pen; a package's own may begin like another one"""


def tell_shadowed(names: Iterable[str]) -> None:
    """One line on standard error for each card that hides a built-in one, or has the name of one.

    A card by its path has the name of its file, under which its results are stored.
    """
    for name in dict.fromkeys(names):
        files = [Path(name)] if name.endswith(".toml") else card_files(name)
        for used in files[:1]:
            built_in = card_folders()[-1] / used.name
            if isfile(used) and isfile(built_in) and not used.samefile(built_in):
                complain(f"solar: note: {used} is used instead of the built-in card {used.stem!r}")


def tell_misspelt(names: Iterable[str]) -> None:
    """One line for each method that a card speaks of, is not here, and looks like one that is.

    Its settings have no effect. Any other unknown method is taken for that of a package.
    """
    known = method_names()
    for name in dict.fromkeys(names):
        card = load_card(name)
        layers = [card.tables, *card.tables.get("variants", {}).values()]
        for method in sorted({method for layer in layers for method in layer.get("methods", {})}):
            if method in known:
                continue
            if close := get_close_matches(method, known, n=1, cutoff=SLIP):
                complain(
                    f"solar: note: card {card.path}: 'methods.{method}' has no effect, as no such "
                    f"method is installed: did you mean {close[0]!r}?"
                )
