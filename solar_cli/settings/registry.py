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
    learns: bool = True
    """whether episodes make it better; where they do not, it is a level for others"""


ON_POLICY = (
    "Ours: rollouts of whole episodes, collected side by side; the learning rate falls over the "
    "card's horizon, to a twentieth; actions in units of their bound; observations standardised by "
    "the first rollout, from which nothing else is learned; costs after an early end are part of "
    "the last live step's reward. A horizon cuts off, it does not end: the last value counts. The "
    "paper gives no settings."
)
"""deviations that PPO and TRPO share"""

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
        "the last training, so that a policy stays the same one. In both forms: a likelihood "
        "that is calibrated, a cost fitted by convex least squares, at each time step where that "
        "tells more, and what is listed as extras; the cards' variant paper has none of it.",
    ),
    MethodEntry(
        name="vae",
        summary="SOLAR with a variational auto-encoder in place of the structured model; local "
        "dynamics with a Gaussian-mixture prior.",
        source="section 6, VAE ablation",
        settings="solar_cli.settings.local:Vae",
        learner="solar_cli.methods.vae:Vae",
        deviations="The rules around an update and all that is listed as extras are SOLAR's here, "
        "so that only the model differs.",
    ),
    MethodEntry(
        name="lqr-flm",
        summary="LQR with a linear model fitted at each time step under a Gaussian-mixture prior, "
        "to states as they are or to images' principal components.",
        source="Levine and Abbeel 2014 (section 6, App. E.2)",
        settings="solar_cli.settings.local:LqrFlm",
        learner="solar_cli.methods.lqr_flm:LqrFlm",
        deviations="Images are seen by their principal components in the first batch: a linear "
        "model of all pixels at each time step fits no memory. The cost is fitted to collected "
        "costs, as App. E.2 has it. States are whitened. The rules around an update are SOLAR's "
        "here: the KL step and its adaptation, going back to the best policy, bounds of its noise.",
    ),
    MethodEntry(
        name="rce",
        summary="SOLAR with robust locally linear controllable embedding, an E2C, in place of the "
        "structured model; local dynamics by linearising its transition network.",
        source="Banijamali et al. 2018 (section 6, E2C-like ablation)",
        settings="solar_cli.settings.local:Rce",
        learner="solar_cli.methods.rce:Rce",
        deviations="Frames are encoded one by one: where there is a window, A maps the newest "
        "latents, and differences back through the window enter linearly, as the action does. The "
        "network works in units of the latents' std. Likelihood and schedules are SOLAR's here, so "
        "that only the model differs. Where the encoder is frozen, the transition network is "
        "fitted further in every iteration. Control is SOLAR's LQR on its slopes, with offsets and "
        "noise from its errors, and not iLQR on its rollouts.",
    ),
    MethodEntry(
        name="global-mpc",
        summary="SOLAR's representation with neural dynamics and a neural cost on it, and planning "
        "by the cross-entropy method at every step.",
        source="section 6, global model ablation",
        settings="solar_cli.settings.global_mpc:GlobalMpc",
        learner="solar_cli.methods.global_mpc:GlobalMpc",
        deviations="A plan goes on from that of the step before, so that a fifth of the release's "
        "1024 samples and fewer than its 10 iterations do; the release trained its dynamics to "
        "predict z' and rolled them out as z + f, ours predict and are rolled out as changes, over "
        "three steps; no push forward for the car (variant forward has it).",
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
        deviations="Their 60 passes over episodes of 1000 steps would be 120 gradient steps for "
        "ours: 1000 an iteration, and the best by held-out episodes is kept. The first episodes "
        "are of uniform actions.",
    ),
    MethodEntry(
        name="pixel-mpc",
        summary="Video prediction and a cost network in pixel space, and the cross-entropy method "
        "under them at every step.",
        source="section 6, pixel space model; Finn and Levine 2017",
        settings="solar_cli.settings.pixel_mpc:PixelMpc",
        learner="solar_cli.methods.pixel_mpc:PixelMpc",
        observations=("image",),
        deviations="The paper gives no details. Frames are predicted after pooling, for speed. The "
        "layers of a frame are its own soft masks, made once from the frame seen and moved by "
        "distances that add up, where Finn and Levine move the last prediction again at every step "
        "and blur it; a learned background fills what they leave, and there is no recurrent state: "
        "what is predicted goes back into the window. The planner minimises a learned cost of "
        "predicted frames and the known cost of actions, not the distance of marked pixels.",
    ),
    MethodEntry(
        name="ppo",
        summary="Model-free: a policy network improved on its own episodes, by clipped likelihood "
        "ratios (Stable-Baselines3).",
        source="Schulman et al. 2017 (section 6)",
        settings="solar_cli.settings.on_policy:Ppo",
        learner="solar_cli.methods.ppo:Ppo",
        deviations=f"Networks, buffer, advantages and update are Stable-Baselines3's. {ON_POLICY} "
        "An update stops at a KL of 1.5 x stop_kl.",
    ),
    MethodEntry(
        name="trpo",
        summary="Model-free: a policy network improved on its own episodes, by natural gradients "
        "within a KL bound (sb3-contrib).",
        source="Schulman et al. 2015 (section 6)",
        settings="solar_cli.settings.on_policy:Trpo",
        learner="solar_cli.methods.trpo:Trpo",
        deviations=f"Networks, buffer, advantages and update are sb3-contrib's. {ON_POLICY} "
        "For speed a step is computed on every fourth sample, by 10 conjugate gradients.",
    ),
    MethodEntry(
        name="zero",
        summary="A reference: no action at all.",
        source="reference policy",
        settings="solar_cli.settings.reference:Reference",
        learner="solar_cli.methods.reference:Zero",
        learns=False,
    ),
    MethodEntry(
        name="random",
        summary="A reference: actions drawn uniformly between their bounds.",
        source="reference policy",
        settings="solar_cli.settings.reference:Reference",
        learner="solar_cli.methods.reference:Random",
        learns=False,
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


def is_level(name: str) -> bool:
    """Whether a method is known to learn nothing; it may be gone, where results are read."""
    try:
        return not method(name).learns
    except SolarError:
        return False


def load(path: str) -> Any:
    """The object at ``module:name``."""
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def settings_class(entry: MethodEntry) -> type[Settings]:
    """The settings model of a method."""
    found: type[Settings] = load(entry.settings)
    return found
