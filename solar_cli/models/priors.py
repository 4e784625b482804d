"""Priors over latent trajectories: SOLAR's Bayesian linear dynamical system, the VAE's N(0, I).

Axes: S segments, L frames of a segment, W frames of a window, d latents of a frame, a actions,
p = W d + a + 1 regressors (the constant 1 gives the dynamics an affine term), T actions an episode.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from solar_cli.inference import lds, mniw, niw
from solar_cli.models.basis import LatentBasis
from solar_cli.models.transition import TransitionNetwork
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import Dynamics


class Segments(NamedTuple):
    """Gaussians of the latents of segments of consecutive frames, float64 but in a minibatch.

    What the encoder says of each frame; or a posterior q(z), whose frames may depend on each other.
    All segments have L frames of an episode's T + 1. Where they are shorter than an episode, their
    starts are taken as drawn uniformly: what such segments reach less often counts for more.
    """

    mean: Float[Tensor, "S L d"]
    variance: Float[Tensor, "S L d"]
    actions: Float[Tensor, "S L_1 a"]
    start: Int[Tensor, " S"]
    """time step of the first frame; 0 where an episode begins"""
    live: Bool[Tensor, "S L"] | None = None
    """the frames that count, the first ones of each segment; None where all do"""
    starts: Int[Tensor, " S"] | None = None
    """starts that a segment of each one's episode can have; None for a whole episode's T + 2 - L"""
    noise: Float[Tensor, "S L d"] | None = None
    """standard normal draws of a sample of each factor; None where none is drawn"""
    smoothed: lds.Smoothed | None = None
    """of a posterior whose frames depend on each other: all of its moments, hidden latents too"""
    kl: Float[Tensor, " S"] | None = None
    """KL(q(z) || prior) of each segment, where there is ``smoothed``"""

    def decoded_from(self, latents: Float[Tensor, "n d"]) -> Float[Tensor, "n d"] | None:
        """``latents`` of this posterior for a decoder; None where they are the encoder's own."""
        return None if self.smoothed is None else latents.float()

    def counted(self, part: Float[Tensor, "S n *rest"]) -> Float[Tensor, "k *rest"]:
        """Of one value a frame, or a transition to one of the last n frames: those that count."""
        if self.live is None:
            return part.flatten(0, 1)
        return part[self.live[:, self.live.shape[1] - part.shape[1] :]]

    def of(self, rows: slice) -> Segments:
        """Some of them."""
        return Segments(*(None if part is None else part[rows] for part in self))  # type: ignore[arg-type]

    @staticmethod
    def joined(parts: Sequence[Segments]) -> Segments:
        """Those of several batches of whole episodes."""
        masks = [
            torch.ones_like(part.mean[..., 0], dtype=torch.bool) if part.live is None else part.live
            for part in parts
        ]
        mean, variance, actions, start = (
            torch.cat(field) for field in zip(*(part[:4] for part in parts), strict=True)
        )
        whole = all(part.live is None for part in parts)
        return Segments(mean, variance, actions, start, None if whole else torch.cat(masks))


class LatentPrior(NamedTuple):
    """What a representation knows of its dynamics, for INFERDYNAMICS."""

    factor: mniw.RegressionStatistics | None
    """q(F, Sigma) over [windows of latents; a; 1], or None for a representation without"""
    basis: LatentBasis
    latent: int
    """d: entries of the newest block"""
    transition: TransitionNetwork | None = None
    """the network that its own dynamics are, or None for a representation without"""


class Prior(Protocol):
    """What the representation is asked to look like."""

    def inferred(self, encoded: Segments) -> Segments:
        """The posterior q(z), given what the encoder says of each frame."""

    def sampled(
        self, encoded: Segments, noise: Float[Tensor, "S L d"]
    ) -> tuple[Float[Tensor, "S L d"], Segments]:
        """float32 latents of every frame drawn from the posterior, and the posterior."""

    def settle(self) -> None:
        """End a training: what ``read`` and ``follow`` do is as of now, and changes no more."""

    @property
    def hidden(self) -> int:
        """Latents that no frame shows: the last ones that are read, beside the encoder's."""

    def read(self, encoded: Segments) -> Float[Tensor, "S L d"]:
        """Latents of whole episodes as control sees them: of each frame and those before it."""

    def follow(
        self,
        mean: Float[Tensor, "N d"],
        variance: Float[Tensor, "N d"],
        belief: Any,
        actions: Float[Tensor, "N a"] | None,
        t: int,
    ) -> tuple[Float[Tensor, "N d"], Any]:
        """One step of ``read`` while episodes run: latents of the newest frame, and the belief.

        ``mean`` and ``variance`` are the encoder's; ``belief`` is what the step before returned and
        ``actions`` were executed since, both None at t = 0.
        """

    @property
    def transition(self) -> TransitionNetwork | None:
        """A network that predicts latents, or None for a prior without."""

    def parameters(self) -> Iterable[nn.Parameter]:
        """What Adam trains of it, beside the networks of frames."""

    @property
    def factor(self) -> mniw.RegressionStatistics | None:
        """q(F, Sigma) over [windows of latents; a; 1], or None for a prior without dynamics."""

    def statistics(self, segments: Segments) -> Any:
        """What ``kl`` and ``learn`` need to know of segments; differentiable."""

    def kl(self, statistics: Any) -> Tensor:
        """KL(q(z) || prior), nats a frame."""

    def learn(self, statistics: Any, scale: float) -> None:
        """One natural-gradient step (Eq. 6); ``scale`` is B, episodes a segment stands for."""

    def conclude(self, episodes: Segments) -> None:
        """End a training: the closed form given whole ``episodes``, all there are."""

    def given(self, episodes: Segments) -> mniw.RegressionStatistics | None:
        """The factor given whole ``episodes`` alone; None for a prior without dynamics."""

    def judged(self, statistics: Any) -> dict[str, float]:
        """How well a network of its own does on segments that it was not trained on."""

    def metrics(self) -> dict[str, float]:
        """KL of the factors over parameters, in nats."""

    def state_dict(self) -> dict[str, Any]:
        """Natural parameters."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take them up."""


class MeanField:
    """q(z) is what the encoder says, frame by frame (Eq. 5); no networks beside the encoder's."""

    hidden = 0

    def parameters(self) -> Iterable[nn.Parameter]:
        """None."""
        return ()

    def judged(self, statistics: Any) -> dict[str, float]:
        """No network to judge."""
        return {}

    def inferred(self, encoded: Segments) -> Segments:
        """As encoded."""
        return encoded

    def sampled(
        self, encoded: Segments, noise: Float[Tensor, "S L d"]
    ) -> tuple[Float[Tensor, "S L d"], Segments]:
        """Each frame on its own, in the precision of the networks."""
        sample = encoded.mean + encoded.variance.sqrt() * noise
        doubles = encoded._replace(
            mean=encoded.mean.double(), variance=encoded.variance.double(), noise=noise.double()
        )
        return sample, doubles

    def settle(self) -> None:
        """The encoder's mean is all there is to read."""

    def read(self, encoded: Segments) -> Float[Tensor, "S L d"]:
        """The encoder's mean."""
        return encoded.mean

    def follow(
        self,
        mean: Float[Tensor, "N d"],
        variance: Float[Tensor, "N d"],
        belief: Any,
        actions: Float[Tensor, "N a"] | None,
        t: int,
    ) -> tuple[Float[Tensor, "N d"], Any]:
        """The encoder's mean; nothing is carried."""
        return mean, None


class StandardNormal(MeanField):
    """p(z_t) = N(0, I): the VAE ablation."""

    factor = None
    transition = None

    def statistics(self, segments: Segments) -> Segments:
        """The segments as they are."""
        return segments

    def kl(self, statistics: Segments) -> Tensor:
        """KL(N(mean, variance) || N(0, I)), nats a frame."""
        kl = standard_normal_kl(statistics.mean, statistics.variance)
        return statistics.counted(kl).mean()

    def learn(self, statistics: Segments, scale: float) -> None:
        """Nothing to learn."""

    def conclude(self, episodes: Segments) -> None:
        """Nothing to learn."""

    def given(self, episodes: Segments) -> None:
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


class DynamicsStatistics(NamedTuple):
    """Expected statistics of segments, each transition and start weighed (see `Segments`).

    With a factor a time step, those of transitions have a leading axis T.
    """

    transitions: mniw.RegressionStatistics
    transitions_log_variance: Float[Tensor, "*T"]
    """sum of the logarithms of the variances of z_{t+1}"""
    starts: mniw.RegressionStatistics
    starts_log_variance: Float[Tensor, ""]
    judged: int | Tensor
    """frames that these terms judge: S times those of an episode"""


class BayesianLDS(MeanField):
    """MNIW factors over (F, Sigma) and the NIW factor over (mu, Sigma_0), Eq. 2 to 5.

    With ``factors = "shared"`` one factor explains every time step, else each has its own. Only
    whole windows are judged: frames 1 to W - 1 of an episode stand in no term, and factors of time
    steps before W - 1 stay the prior.
    """

    transition = None

    def __init__(
        self,
        settings: Dynamics,
        latent: int,
        task: TaskSettings,
        device: str,
    ) -> None:
        self.settings = settings
        self.window = window = task.observation.window
        self.horizon = task.horizon
        d = latent if settings.rows == "newest" else latent * window
        p = latent * window + task.action.size + 1
        zero = torch.zeros((), dtype=torch.float64, device=device)
        degrees = zero + d + 2.0
        q = mniw.MNIW(
            Psi=settings.prior_scale * (degrees + d + 1) * torch.eye(d).to(zero),
            nu=degrees,
            M=self._prior_mean(d, p).to(zero),
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

    def _prior_mean(self, d: int, p: int) -> Float[Tensor, "d p"]:
        """It copies the newest block: latents change little in one step."""
        return torch.eye(d, p)

    def statistics(self, segments: Segments) -> DynamicsStatistics:
        """Expected sufficient statistics, such that their mean over starts is an episode's."""
        count = len(segments.start)
        times, weights, start_weights = self._weights(segments)
        x, x_variance, y, y_variance = self._transitions(segments)
        logs = y_variance.log().sum(dim=-1)
        if self.settings.factors == "shared":
            flat = [part.flatten(0, 1) for part in (x, y, x_variance, y_variance, weights)]
            transitions = mniw.regression_statistics(*flat)
            log_variance = (weights * logs).sum()
        else:
            # One "sample axis" of length 1 a transition, then summed by time step.
            single = mniw.regression_statistics(
                *(part.flatten(0, 1)[:, None] for part in (x, y, x_variance, y_variance, weights))
            )
            at = times.flatten()
            transitions = mniw.RegressionStatistics(
                *(
                    torch.zeros_like(p).index_add(0, at, s)
                    for p, s in zip(self.prior, single, strict=True)
                )
            )
            log_variance = torch.zeros_like(self.prior.n).index_add(
                0, at, (weights * logs).flatten()
            )
        first, variance = segments.mean[:, 0], segments.variance[:, 0]
        starts = niw.initial_statistics(first, variance, start_weights)
        starts_log_variance = (start_weights * variance.log().sum(dim=-1)).sum()
        judged: int | Tensor = count * (self.horizon + 2 - self.window)
        if segments.live is not None:
            judged = int(segments.live[:, self.window :].sum()) + count
        elif segments.starts is not None:  # episodes differ: what these segments show, as weighed
            judged = weights.sum() + start_weights.sum()
        return DynamicsStatistics(transitions, log_variance, starts, starts_log_variance, judged)

    def _weights(
        self, segments: Segments
    ) -> tuple[Int[Tensor, "S n"], Float[Tensor, "S n"], Float[Tensor, " S"]]:
        """Time step t of each transition z_t -> z_{t+1}, its weight, and the weight of each start.

        The weight is the number of starts a segment can have over that of those which reach t: the
        inverse of the chance that a segment shows it. Every start of every episode has the same
        chance; where episodes end early, theirs are counted.
        """
        start, length = segments.start, segments.mean.shape[1]
        starts = self.horizon + 2 - length
        own = torch.full_like(start, starts) if segments.starts is None else segments.starts
        times = start[:, None] + torch.arange(self.window - 1, length - 1, device=start.device)
        first = (times - length + 2).clamp_min(0)
        last = torch.minimum(times - self.window + 1, own[:, None] - 1)
        weights = starts / (last - first + 1).clamp_min(1).double()
        if segments.live is not None:
            weights = weights * segments.live[:, self.window :]
        return times, weights, starts * (start == 0).double()

    def _transitions(self, segments: Segments) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(x mean, x variance, y mean, y variance) of all transitions, (S, n, ...)."""
        mean = regressors(segments.mean, self.window)
        variance = regressors(segments.variance, self.window)
        actions = segments.actions[:, self.window - 1 :]
        known = torch.cat([actions, torch.ones_like(actions[..., :1])], dim=-1)
        x = torch.cat([mean[:, :-1], known], dim=-1)
        x_variance = torch.cat([variance[:, :-1], torch.zeros_like(known)], dim=-1)
        if self.settings.rows == "all":
            return x, x_variance, mean[:, 1:], variance[:, 1:]
        newest = slice(self.window, None)
        return x, x_variance, segments.mean[:, newest], segments.variance[:, newest]

    def kl(self, statistics: DynamicsStatistics) -> Tensor:
        """Transition terms and the t = 0 term of the ELBO, a frame that they judge."""
        expected = mniw.expected_statistics(self.factor)
        transitions = mniw.expected_transition_kl(
            expected, statistics.transitions, statistics.transitions_log_variance
        )
        starts = niw.expected_initial_kl(
            self.initial, statistics.starts, statistics.starts_log_variance
        )
        return (transitions.sum() + starts) / statistics.judged

    @torch.no_grad()
    def learn(self, statistics: DynamicsStatistics, scale: float) -> None:
        """One natural-gradient step on both factors (Eq. 6)."""
        rate = self.settings.rate
        self.factor = mniw.natural_gradient_step(
            self.factor, self.prior, statistics.transitions, scale, rate
        )
        self.initial = niw.natural_gradient_step(
            self.initial, self.initial_prior, statistics.starts, scale, rate
        )

    @torch.no_grad()
    def conclude(self, episodes: Segments) -> None:
        """The exact conjugate update, a step of rate 1; or another step, where settings say so."""
        statistics = self.statistics(episodes)
        if not self.settings.closed_form:
            self.learn(statistics, 1.0)
            return
        self.factor = self.prior.plus(statistics.transitions)
        self.initial = self.initial_prior.plus(statistics.starts)

    @torch.no_grad()
    def given(self, episodes: Segments) -> mniw.RegressionStatistics:
        """The exact posterior over (F, Sigma) given ``episodes`` alone."""
        return self.prior.plus(self.statistics(episodes).transitions)

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
