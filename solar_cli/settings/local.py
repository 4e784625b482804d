"""Settings of the local methods: a representation + a local dynamics fit + KL-constrained LQR."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from solar_cli.settings.networks import BUMPS, KEY_POINTS, Layer
from solar_cli.settings.schema import MOST_EPISODES, Settings, setting
from solar_cli.settings.task import Observation

Positive = Annotated[float, Field(gt=0)]


class Budget(Settings):
    """Where to stop, in episodes; never part of a cell's identity."""

    desk: int = setting(..., "episodes for an evening", presentation=True, ge=1, le=MOST_EPISODES)
    full: int = setting(..., "the paper's, or for long", presentation=True, ge=1, le=MOST_EPISODES)


class Batches(Settings):
    """Episodes an iteration collects (Algorithm 1, line 4)."""

    initial: int = setting(..., "white-noise episodes before the first model", "App. D", ge=2)
    noisy: int = setting(..., "episodes of the policy with its noise, an iteration", "App. D", ge=2)
    noise_free: int = setting(
        0,
        "further episodes an iteration without noise, which judge the policy; of a planner, which "
        "has nothing to judge, with its noise",
        ge=0,
    )


class Representation(Settings):
    """Recognition model e(s) and observation model f(z) (section 3)."""

    latent: int = setting(8, "dimensions of the latent block of one frame", "App. D", ge=1)
    encoder: tuple[Layer, ...] = setting(
        KEY_POINTS, "recognition network, applied to each frame", min_length=1
    )
    head: Literal["linear", "none"] = setting(
        "linear", "linear map from the last layer to the latent mean, or the layer itself"
    )
    variance: Positive | Literal["learned"] = setting(
        "learned", "variance of q(z|s): a learned diagonal, or this number"
    )
    decoder: tuple[Layer, ...] = setting(BUMPS, "observation network, applied to each frame")
    likelihood: Literal["calibrated", "bernoulli", "categorical", "gaussian"] = setting(
        "calibrated",
        "p(s|z): Gaussian with the best common scale on an image pyramid, or as App. D says",
    )
    nats: float = setting(
        512.0,
        "calibrated: half the dimensions of a frame that count, weight of the log error",
        gt=0,
    )
    pyramid: bool = setting(
        False, "calibrated: errors of pooled frames count too, so that small misplaced things do"
    )
    input: Literal["standardised", "unit"] = setting(
        "standardised", "(x - mean image) / pixel std, or x in [0, 1]"
    )


class Dynamics(Settings):
    """The Bayesian linear dynamical system over latents (Eq. 2-5)."""

    posterior: Literal["mean-field", "smoother"] = setting(
        "mean-field",
        "q(z): a factor a frame (Eq. 5), or what a smoother infers from single frames by the "
        "dynamics; control then sees the means of its filter",
        "Eq. 5; the authors' release smooths",
        added="mean-field",
    )
    hidden: int = setting(
        0,
        "smoother: further latents that no single frame shows, velocities; the release has none",
        ge=0,
        added=0,
    )
    factors: Literal["shared", "varying"] = setting(
        "shared", "one q(F, Sigma) for all time steps, or one a time step as in Eq. 5"
    )
    rows: Literal["newest", "all"] = setting(
        "newest", "model the newest latent block (the rest shifts), or the whole z_{t+1}"
    )
    prior_scale: float = setting(1e-3, "Psi_0 = this x (nu_0 + d + 1) I, nu_0 = d + 2", gt=0)
    prior_precision: float = setting(1e-2, "V_0^-1 = this x I", gt=0)
    rate: float = setting(0.02, "natural-gradient step of each minibatch (Eq. 6)", gt=0, le=1)
    closed_form: bool = setting(
        True, "end a training with the exact posterior: a step of rate 1 on the whole data"
    )

    @model_validator(mode="after")
    def _hidden_is_inferred(self) -> Self:
        if self.hidden and self.posterior != "smoother":
            raise ValueError("hidden: only posterior = 'smoother' infers what no frame shows")
        return self


class Transition(Settings):
    """RCE's networks of transitions: z' = A z + B u + o at every place, A = I + v r^T."""

    hidden: tuple[Annotated[int, Field(ge=1)], ...] = setting(
        (100, 100), "rectified layers of the network for A, B and o", "E2C"
    )
    recognition: tuple[Annotated[int, Field(ge=1)], ...] = setting(
        (100,), "rectified layers of q(zbar | x, z'): the place of the linearisation"
    )
    steps: int = setting(
        300, "gradient steps of these networks after a training and in every iteration", ge=0
    )
    batch: int = setting(256, "transitions of such a step", ge=1)
    rate: float = setting(1e-3, "Adam, in such steps; it falls to 0", gt=0)


class Training(Settings):
    """Stochastic maximisation of the ELBO (section 3)."""

    steps: int = setting(2000, "gradient steps of the first training", ge=1)
    fine_tune_steps: int = setting(0, "gradient steps in later iterations; 0 freezes e(s)", ge=0)
    fine_tune_rate: float = setting(3e-4, "Adam, in later iterations", gt=0)
    buffer: int = setting(
        3, "B: iterations whose batches later trainings draw from", "Alg. 1", ge=1
    )
    segments: int = setting(10, "segments of consecutive frames a step", ge=1)
    length: int = setting(12, "frames of a segment", ge=2)
    decoded: float = setting(0.5, "share of a step's frames that are decoded", gt=0, le=1)
    learning_rate: float = setting(5e-3, "Adam", gt=0)
    schedule: Literal["cosine", "constant"] = setting("cosine", "of the learning rate")
    clip: float = setting(50.0, "largest norm of the gradient", gt=0)
    kl_start: float = setting(1e-4, "weight of the KL terms at first", gt=0)
    kl_end: float = setting(1.0, "weight of the KL terms at last", gt=0)
    kl_hold: float = setting(0.2, "share of the steps with the first weight", ge=0, le=1)
    kl_ramp: float = setting(0.3, "share of the steps over which it rises", ge=0, le=1)
    standard_normal: float = setting(0.05, "weight of a further KL to N(0, I)", ge=0)
    held_out: float = setting(0.15, "share of the collected episodes kept for scoring", gt=0, lt=1)
    attempts: int = setting(
        3, "first trainings at most, until one explains 0.7 of the collected costs", ge=1
    )


class LocalFit(Settings):
    """INFERDYNAMICS: where the prior of a time step's posterior comes from (section 4.1)."""

    method: Literal["posterior", "regression", "gmm"] = setting(
        "posterior", "posterior inference; least squares; a Gaussian-mixture prior (LQR-FLM)"
    )
    prior_counts: tuple[float, ...] | Literal["own"] = setting(
        (0.0, 1.0, 10.0, 100.0),
        "pseudo-counts of the model's factor given older batches, chosen by held-out likelihood; "
        "or the factor as it stands (section 4.1)",
        min_length=1,
    )
    widths: tuple[float, ...] = setting(
        (2.0, 5.0), "reach of neighbouring time steps, chosen by held-out likelihood", min_length=1
    )
    neighbours: tuple[float, ...] = setting(
        (0.0, 0.5), "weight of neighbouring time steps, chosen by held-out likelihood", min_length=1
    )
    older_counts: tuple[float, ...] = setting(
        (0.0, 10.0), "pseudo-counts of older batches, chosen by held-out likelihood", min_length=1
    )
    older_batches: int = setting(3, "earlier iterations whose batches may be used", ge=0)
    folds: int = setting(3, "folds of the held-out likelihood", ge=2)
    ridge: float = setting(
        0.003, "noise of a latent, in units of its std, that slopes must bear", gt=0
    )


class NetworkFit(LocalFit):
    """Where the model has a network of transitions, its slopes can be the dynamics' too."""

    method: Literal["network", "regression", "gmm"] = setting(  # type: ignore[assignment]
        "network", "slopes of the model's own network; least squares; a Gaussian-mixture prior"
    )


class CostFit(Settings):
    """c_t = 1/2 z^T L L^T z + c^T z + alpha |a|^2 + b (section 3)."""

    optimiser: Literal["convex", "sgd"] = setting(
        "convex",
        "least squares with C >= 0; sgd: full-batch descent on L, of the fit for all time steps",
    )
    ridge: tuple[float, ...] = setting(
        (1e-6, 1e-4, 1e-2, 0.1, 1.0),
        "weight of squared coefficients, in standardised units, chosen by held-out R2",
        min_length=1,
        added=[0.0],
    )
    older: tuple[float, ...] = setting(
        (0.0, 1.0),
        "weight of samples of older batches, chosen by held-out R2",
        min_length=1,
        added=[0.0],
    )
    width: float = setting(5.0, "reach in time steps of a per-time fit", gt=0)
    per_time: Literal["chosen", "never"] = setting(
        "chosen",
        "a fit per time step, of steps nearby or around the episodes, where held-out costs say so; "
        "or never",
    )
    terminal: float = setting(3.0, "weight of the cost of the last state", gt=0)


class PolicyUpdate(Settings):
    """KL-constrained LQR and the rules around it (section 4.2)."""

    kl_step: Positive | Literal["unbounded"] = setting(
        0.5, "nats a time step that the trajectory distribution may move"
    )
    multiplier: tuple[Positive, Positive] = setting(
        (0.3, 4.0), "bounds of what kl_step is multiplied by, from what updates promised and gave"
    )
    linearise: bool = setting(True, "line 6 of Algorithm 1, when e(s) has changed")
    reject: Annotated[float, Field(ge=0)] | Literal["never"] = setting(
        1.0, "standard errors by which a batch may be worse than the best before going back"
    )
    rejected_batches: int = setting(
        2,
        "batches of policies that were taken back since, the last ones, that are learned from too",
        ge=0,
        added=0,
    )
    std_floor: tuple[Positive, Positive] = setting(
        (0.67, 0.33), "least std over the initial one: first updates, later ones"
    )
    std_ceiling: float = setting(2.0, "largest std over the initial one", gt=0)
    early_updates: int = setting(3, "updates that the first floor holds for", ge=0)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.multiplier[0] > self.multiplier[1]:
            raise ValueError("multiplier: the lower bound is above the upper one")
        if max(self.std_floor) > self.std_ceiling:
            raise ValueError("std_floor: a floor is above std_ceiling")
        return self


class StateMethod(Settings):
    """A method whose states are windows of latents, or of what is observed."""

    batches: Batches = setting(..., "line 4 of Algorithm 1")
    budget: Budget = setting(..., "where to stop", presentation=True)
    whitening: bool = setting(
        True, "states have unit variance, and differences in place of older latents", added=True
    )

    @abstractmethod
    def latents(self, observation: Observation) -> int:
        """d: latents that one frame shows."""


class LatentMethod(StateMethod):
    """A method that works in a learned latent space."""

    representation: Representation = setting(Representation(), "networks")
    training: Training = setting(Training(), "line 5 of Algorithm 1")

    def latents(self, observation: Observation) -> int:
        """As many as the representation has."""
        return self.representation.latent


class LocalControl(StateMethod):
    """A local method, whatever its states are."""

    local_fit: LocalFit = setting(LocalFit(), "line 7 of Algorithm 1")
    cost_fit: CostFit = setting(CostFit(), "quadratic cost")
    update: PolicyUpdate = setting(PolicyUpdate(), "lines 6 and 8 of Algorithm 1")


class LocalMethod(LocalControl, LatentMethod):
    """A local method in the latent space: SOLAR and its ablations."""


class Solar(LocalMethod):
    """SOLAR: the representation has a Bayesian linear dynamical system as its prior."""

    dynamics: Dynamics = setting(Dynamics(), "the model's prior over latent dynamics")


class Vae(LocalMethod):
    """The VAE ablation: a standard-normal prior, local dynamics with a Gaussian-mixture prior."""

    training: Training = setting(Training(standard_normal=0.0), "line 5 of Algorithm 1")
    local_fit: LocalFit = setting(LocalFit(method="gmm"), "line 7 of Algorithm 1")


class Rce(LocalMethod):
    """RCE: a network of locally linear transitions is the prior and, linearised, the dynamics."""

    transition: Transition = setting(Transition(), "the model's own dynamics")
    training: Training = setting(Training(standard_normal=0.0), "line 5 of Algorithm 1")
    local_fit: NetworkFit = setting(NetworkFit(), "line 7 of Algorithm 1")


class LqrFlm(LocalControl):
    """LQR with fitted linear models: states as they are, or principal components of images."""

    components: int = setting(
        20, "principal components of an image; an observed state is taken whole", ge=1, le=50
    )
    local_fit: LocalFit = setting(
        LocalFit(method="gmm"), "line 7 of Algorithm 1", "Levine and Abbeel 2014"
    )

    def latents(self, observation: Observation) -> int:
        """Entries of an observed state, or principal components of an image."""
        size = math.prod(observation.frame_shape)
        return min(self.components, size) if observation.kind == "image" else size
