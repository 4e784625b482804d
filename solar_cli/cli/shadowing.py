"""Cards of ``./tasks`` that hide a card of the same name that comes with Solar."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from solar_cli.cli.printing import complain
from solar_cli.settings.card import card_folders


def card_files(name: str) -> list[Path]:
    """The files of that card; the first one is read, and a folder is no card."""
    return [path for folder in card_folders() if (path := folder / f"{name}.toml").is_file()]


def tell_shadowed(names: Iterable[str]) -> None:
    """One line on standard error for each card that hides a built-in one."""
    for name in dict.fromkeys(names):
        files = card_files(name)
        if len(files) > 1 and not files[0].samefile(files[1]):
            complain(f"solar: note: {files[0]} is used instead of the built-in card {name!r}")
