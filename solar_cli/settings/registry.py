"""The methods: names -> entries with import paths, loaded when used, so that listing is cheap.

A package brings its own method through the entry-point group ``solar.methods``; the entry point
names a `MethodEntry`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from solar_cli.errors import SolarError, UsageError, nearest
from solar_cli.settings.schema import Settings

GROUP = "solar.methods"


@dataclass(frozen=True)
class MethodEntry:
    """What is known of a method without importing it."""

    name: str
    """as in ``--method``"""
    summary: str
    """one sentence: what is learned, and how"""
    source: str
    """paper section, or publication"""
    settings: str
    """``module:Class`` of its settings (no torch there); they have a ``budget`` table"""
    learner: str
    """``module:Class`` of the learner"""
    observations: tuple[Literal["image", "state"], ...] = ("image", "state")
    """kinds of observation it can learn from"""
    needs: Literal["costs", "true cost"] = "costs"
    """whether it sees the collected costs only, or the task's cost function"""
    deviations: str = ""
    """where it departs from its source, and why"""


BUILT_IN = (
    MethodEntry(
        name="solar",
        summary="Latents with a Bayesian linear dynamical system as prior; local dynamics by "
        "posterior inference; KL-constrained LQR.",
        source="Algorithm 1",
        settings="solar_cli.settings.local:Solar",
        learner="solar_cli.methods.solar:Solar",
        deviations="With dynamics.posterior = 'smoother' it is the authors' release but for these: "
        "hidden latents, which no frame shows, since an encoder that may say something of every "
        "latent makes all of them positions; segments of episodes, N(0, I) being the prior of a "
        "first state in the middle of one; local dynamics and costs of filtered means, on which "
        "the policy acts, in place of EM over smoothed ones; and the filter keeps the dynamics of "
        "the last training, so that a policy stays the same one.",
    ),
    MethodEntry(
        name="vae",
        summary="SOLAR with a variational auto-encoder in place of the structured model; local "
        "dynamics with a Gaussian-mixture prior.",
        source="section 6, VAE ablation",
        settings="solar_cli.settings.local:Vae",
        learner="solar_cli.methods.vae:Vae",
    ),
    MethodEntry(
        name="mpc-nn",
        summary="Neural dynamics of states, and the best of random action sequences under them and "
        "the task's own cost.",
        source="Nagabandi et al. 2018 (App. E.2)",
        settings="solar_cli.settings.mpc_nn:MpcNn",
        learner="solar_cli.methods.mpc_nn:MpcNn",
        observations=("state",),
        needs="true cost",
    ),
    MethodEntry(
        name="zero",
        summary="A reference: no action at all.",
        source="reference policy",
        settings="solar_cli.settings.reference:Reference",
        learner="solar_cli.methods.reference:Zero",
    ),
    MethodEntry(
        name="random",
        summary="A reference: actions drawn uniformly between their bounds.",
        source="reference policy",
        settings="solar_cli.settings.reference:Reference",
        learner="solar_cli.methods.reference:Random",
    ),
)


def _foreign(point: EntryPoint) -> MethodEntry:
    """Load the entry of another package; whatever is wrong with it is one clear line."""
    try:
        entry = point.load()
    except Exception as error:
        raise SolarError(
            f"method {point.name!r} of entry point {point.value!r} cannot be loaded "
            f"({type(error).__name__}: {error}): reinstall or remove its package"
        ) from error
    if not isinstance(entry, MethodEntry) or entry.name != point.name:
        raise SolarError(
            f"entry point {point.value!r} of group {GROUP!r} is not a MethodEntry named "
            f"{point.name!r}: correct or remove its package"
        )
    return entry


@cache
def _known() -> dict[str, MethodEntry | EntryPoint]:
    methods: dict[str, MethodEntry | EntryPoint] = {entry.name: entry for entry in BUILT_IN}
    for point in entry_points(group=GROUP):
        if point.name in methods:
            raise SolarError(f"two methods are named {point.name!r}: remove the package of one")
        methods[point.name] = point
    return methods


def method_names() -> list[str]:
    """Names of all methods, built in and installed, without importing any."""
    return sorted(_known())


def method(name: str) -> MethodEntry:
    """The entry of a method. Raises `UsageError` for an unknown name."""
    known = _known()
    if name not in known:
        raise UsageError(f"unknown method {name!r}: {nearest(name, known)}")
    entry = known[name]
    return entry if isinstance(entry, MethodEntry) else _foreign(entry)


def load(path: str) -> Any:
    """The object at ``module:name``."""
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def settings_class(entry: MethodEntry) -> type[Settings]:
    """The settings model of a method."""
    found: type[Settings] = load(entry.settings)
    return found
