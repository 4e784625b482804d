"""Priors over latent trajectories: SOLAR's Bayesian linear dynamical system, the VAE's N(0, I).

Axes: S segments, L frames of a segment, W frames of a window, d latents of a frame, a actions,
p = W d + a + 1 regressors (the constant 1 gives the dynamics an affine term).
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from solar_cli.inference import mniw, niw
from solar_cli.models.basis import LatentBasis
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import Dynamics


class Segments(NamedTuple):
    """Posterior factors q(z | s) of segments of consecutive frames, float64."""

    mean: Float[Tensor, "S L d"]
    variance: Float[Tensor, "S L d"]
    actions: Float[Tensor, "S L_1 a"]
    start: Int[Tensor, " S"]
    """time step of the first frame; 0 where an episode begins"""
    live: Bool[Tensor, "S L"] | None = None
    """the frames that count, the first ones of each segment; None where all do"""

    def counted(self, part: Float[Tensor, "S n *rest"]) -> Float[Tensor, "k *rest"]:
        """Of one value a frame, or a transition to one of the last n frames: those that count."""
        if self.live is None:
            return part.flatten(0, 1)
        return part[self.live[:, self.live.shape[1] - part.shape[1] :]]


class LatentPrior(NamedTuple):
    """What a representation knows of its dynamics, for INFERDYNAMICS."""

    factor: mniw.RegressionStatistics | None
    """q(F, Sigma) over [windows of latents; a; 1], or None for a representation without"""
    basis: LatentBasis
    latent: int
    """d: entries of the newest block"""


class Prior(Protocol):
    """What the representation is asked to look like."""

    @property
    def factor(self) -> mniw.RegressionStatistics | None:
        """q(F, Sigma) over [windows of latents; a; 1], or None for a prior without dynamics."""

    def kl(self, segments: Segments) -> Tensor:
        """KL(q(z) || prior), nats a frame."""

    def learn(self, segments: Segments, weights: tuple[float, float]) -> None:
        """One natural-gradient step (Eq. 6); ``weights`` scale the segments to the whole data:
        one for transitions, one for starts of episodes."""

    def conclude(self, segments: Segments) -> None:
        """End a training: the closed form given ``segments`` as the whole data."""

    def given(self, segments: Segments) -> mniw.RegressionStatistics | None:
        """The factor given ``segments`` alone; None for a prior without dynamics."""

    def metrics(self) -> dict[str, float]:
        """KL of the factors over parameters, in nats."""

    def state_dict(self) -> dict[str, Any]:
        """Natural parameters."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take them up."""


class StandardNormal:
    """p(z_t) = N(0, I): the VAE ablation."""

    factor = None

    def kl(self, segments: Segments) -> Tensor:
        """KL(N(mean, variance) || N(0, I)), nats a frame."""
        kl = standard_normal_kl(segments.mean, segments.variance)
        return segments.counted(kl).mean()

    def learn(self, segments: Segments, weights: tuple[float, float]) -> None:
        """Nothing to learn."""

    def conclude(self, segments: Segments) -> None:
        """Nothing to learn."""

    def given(self, segments: Segments) -> None:
        """No dynamics."""

    def metrics(self) -> dict[str, float]:
        """No parameters."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """No parameters."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """No parameters."""


def standard_normal_kl(mean: Tensor, variance: Tensor) -> Tensor:
    """KL(N(mean, diag variance) || N(0, I)) over the last axis."""
    return 0.5 * (mean.square() + variance - 1 - variance.log()).sum(dim=-1)


def regressors(mean: Float[Tensor, "S L d"], window: int) -> Float[Tensor, "S n Wd"]:
    """Windows of latents, newest block first; window i ends at frame i + W - 1."""
    return mean.unfold(1, window, 1).flip(-1).transpose(-1, -2).flatten(2)


class LinearDynamics:
    """MNIW factors over (F, Sigma) and the NIW factor over (mu, Sigma_0), Eq. 2 to 5.

    With ``factors = "shared"`` one factor explains every time step, else each has its own.
    """

    def __init__(
        self,
        settings: Dynamics,
        latent: int,
        task: TaskSettings,
        device: str,
    ) -> None:
        self.settings = settings
        self.window = window = task.observation.window
        d = latent if settings.rows == "newest" else latent * window
        p = latent * window + task.action.size + 1
        zero = torch.zeros((), dtype=torch.float64, device=device)
        degrees = zero + d + 2.0
        q = mniw.MNIW(
            Psi=settings.prior_scale * (degrees + d + 1) * torch.eye(d).to(zero),
            nu=degrees,
            # The mean copies the newest block: latents change little in one step.
            M=torch.eye(d, p).to(zero),
            V=torch.eye(p).to(zero) / settings.prior_precision,
        )
        steps = () if settings.factors == "shared" else (task.horizon,)
        self.prior = mniw.RegressionStatistics(
            *(part.expand((*steps, *part.shape)).clone() for part in mniw.natural(q))
        )
        self.factor: mniw.RegressionStatistics = self.prior
        # A window at t = 0 repeats the first frame: one block says it all.
        self.initial_prior = niw.natural(
            niw.NIW(
                Psi=(latent + 2.0) * torch.eye(latent).to(zero),
                nu=zero + latent + 2.0,
                mu0=torch.zeros(latent).to(zero),
                kappa=zero + 1.0,
            )
        )
        self.initial = self.initial_prior

    def _times(self, segments: Segments) -> Int[Tensor, "S n"]:
        """Time step t of each transition z_t -> z_{t+1}."""
        count = segments.mean.shape[1] - self.window
        return segments.start[:, None] + torch.arange(
            self.window - 1, self.window - 1 + count, device=segments.start.device
        )

    def _transitions(self, segments: Segments) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(x mean, x variance, y mean, y variance) of all transitions, (S, n, ...)."""
        mean = regressors(segments.mean, self.window)
        variance = regressors(segments.variance, self.window)
        count = mean.shape[1] - 1
        actions = segments.actions[:, self.window - 1 : self.window - 1 + count]
        one = torch.ones_like(actions[..., :1])
        x = torch.cat([mean[:, :-1], actions, one], dim=-1)
        x_variance = torch.cat(
            [variance[:, :-1], torch.zeros_like(actions), torch.zeros_like(one)], dim=-1
        )
        if self.settings.rows == "all":
            return x, x_variance, mean[:, 1:], variance[:, 1:]
        newest = slice(self.window, None)
        return x, x_variance, segments.mean[:, newest], segments.variance[:, newest]

    def kl(self, segments: Segments) -> Tensor:
        """Transition terms and the t = 0 term of the ELBO, averaged over the frames they judge."""
        x, x_variance, y, y_variance = self._transitions(segments)
        expected = mniw.expected_statistics(mniw.standard(self.factor))
        if self.settings.factors == "varying":
            times = self._times(segments)
            expected = mniw.ExpectedStatistics(*(part[times] for part in expected))
        transition = mniw.expected_transition_kl(expected, y, y_variance, x, x_variance)
        transition = segments.counted(transition)
        first = segments.start == 0
        initial = niw.expected_initial_kl(
            niw.standard(self.initial), segments.mean[first, 0], segments.variance[first, 0]
        )
        return (transition.sum() + initial.sum()) / (transition.numel() + initial.numel())

    def _statistics(
        self, segments: Segments
    ) -> tuple[mniw.RegressionStatistics, mniw.RegressionStatistics]:
        x, x_variance, y, y_variance = self._transitions(segments)
        if self.settings.factors == "shared":
            flat = [segments.counted(part) for part in (x, y, x_variance, y_variance)]
            transitions = mniw.regression_statistics(*flat)
        else:
            # One "sample axis" of length 1 a transition, then summed by time step.
            single = mniw.regression_statistics(
                *(segments.counted(part)[:, None] for part in (x, y, x_variance, y_variance))
            )
            times = segments.counted(self._times(segments))
            transitions = mniw.RegressionStatistics(
                *(
                    torch.zeros_like(p).index_add(0, times, s)
                    for p, s in zip(self.prior, single, strict=True)
                )
            )
        first = segments.start == 0
        initial = niw.initial_statistics(segments.mean[first, 0], segments.variance[first, 0])
        return transitions, initial

    @torch.no_grad()
    def learn(self, segments: Segments, weights: tuple[float, float]) -> None:
        """One natural-gradient step on both factors (Eq. 6)."""
        transitions, initial = self._statistics(segments)
        rate = self.settings.rate
        self.factor = mniw.natural_gradient_step(
            self.factor, self.prior, transitions, weights[0], rate
        )
        self.initial = niw.natural_gradient_step(
            self.initial, self.initial_prior, initial, weights[1], rate
        )

    @torch.no_grad()
    def conclude(self, segments: Segments) -> None:
        """The exact conjugate update, a step of rate 1; or another step, where settings say so."""
        if not self.settings.closed_form:
            self.learn(segments, (1.0, 1.0))
            return
        transitions, initial = self._statistics(segments)
        self.factor = self.prior.plus(transitions)
        self.initial = self.initial_prior.plus(initial)

    @torch.no_grad()
    def given(self, segments: Segments) -> mniw.RegressionStatistics:
        """The exact posterior over (F, Sigma) given ``segments`` alone."""
        return self.prior.plus(self._statistics(segments)[0])

    def metrics(self) -> dict[str, float]:
        """KL(q || p) of the factors over parameters: the last terms of the ELBO, in nats."""
        dynamics = mniw.kl_divergence(mniw.standard(self.factor), mniw.standard(self.prior))
        initial = niw.kl_divergence(niw.standard(self.initial), niw.standard(self.initial_prior))
        return {"kl_dynamics": float(dynamics.sum()), "kl_initial": float(initial)}

    def state_dict(self) -> dict[str, Any]:
        """Natural parameters of both factors."""
        return {"factor": list(self.factor), "initial": list(self.initial)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take them up."""
        device = self.prior.yy.device
        self.factor = mniw.RegressionStatistics(*(part.to(device) for part in state["factor"]))
        self.initial = mniw.RegressionStatistics(*(part.to(device) for part in state["initial"]))
