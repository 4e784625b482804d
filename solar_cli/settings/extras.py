"""What local methods have beyond their papers, each read from the setting that turns it off."""

from __future__ import annotations

from collections.abc import Container
from typing import Any, NamedTuple


class Extra(NamedTuple):
    """One of them."""

    name: str
    path: str
    """of its setting, below the method"""
    off: Any
    """value, as JSON data, that turns it off; None where none does"""
    works_by: str = ""
    """path of another setting without which it does nothing"""

    def is_on(self, value: Any) -> bool:
        """Whether it is, given its setting as JSON data."""
        return bool(value != self.off)


EXTRAS = (
    Extra("whitening of states", "whitening", off=False),
    Extra("restarts of poor representations", "training.attempts", off=1),
    Extra("going back to the best policy", "update.reject", off="never"),
    Extra("learning from what was taken back", "update.rejected_batches", 0, "update.reject"),
    Extra("bounds of the policy's noise", "update.std_floor", off=None),
    Extra("judging by episodes without noise", "batches.noise_free", 0, "update.reject"),
)


def extras_of(paths: Container[str]) -> list[Extra]:
    """Those that a method has settings for, given the paths of its settings below it."""
    return [
        extra
        for extra in EXTRAS
        if extra.path in paths and (not extra.works_by or extra.works_by in paths)
    ]
