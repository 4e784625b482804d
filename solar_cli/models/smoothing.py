"""SOLAR's structured posterior: a smoother in training, its filter at run time, single frames.

The encoder gives evidence about each z_t, a Gaussian factor; q(z_0..z_T) is the linear-Gaussian
chain under q(F, Sigma) with that evidence (Johnson et al. 2016; the authors' release of SOLAR). A
latent that no single frame shows, a velocity, is inferred from those before and after. Control has
only those before: it sees the mean of the filter. If the dynamics are right, that mean is a Markov
process with the same F, driven by innovations: what local dynamics and costs are fitted to is what
the policy acts on. The filter keeps the dynamics of the last training, so that a state keeps its
meaning. Taking up those of the newest batches in every iteration, with line 6 between, predicted
more of a step and controlled no better: `reacher` after 660 episodes, -6.5 and -7.6 on two seeds,
in place of -5.6 and -7.8.

Ours: ``hidden`` latents, of which frames say nothing and which the decoder does not see. Where the
encoder may say something of every latent, it makes all of them positions: with ten of those on
`reacher`, local dynamics predicted 1 % of a step's variance. One block Cholesky factorisation in
place of an unrolled log-normaliser that is differentiated twice. No expectation-maximisation within
line 7, which sees filtered means. Factors are concluded by coordinate ascent, which has none of the
bias of natural-gradient steps on minibatches of a q(z) that depends on the factors itself.

Axes as in `priors`, with windows of one frame.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from solar_cli.errors import UsageError
from solar_cli.inference import lds, mniw, niw
from solar_cli.inference.mniw import ExpectedStatistics, RegressionStatistics
from solar_cli.models.priors import BayesianLDS, Segments
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import Dynamics

PACE = 0.1
"""how much a hidden latent is expected to move the one it drives, in a step; both are of order 1"""
ROUNDS = 5
"""of coordinate ascent at the end of a training: each smooths, then gives the factors in closed
form"""


class SmoothedStatistics(NamedTuple):
    """What segments add to the ELBO, and expected statistics weighed as `Segments` says."""

    kl: Float[Tensor, ""]
    """sum over segments"""
    transitions: RegressionStatistics
    starts: RegressionStatistics
    judged: int
    """frames"""


class SmoothedLDS(BayesianLDS):
    """The factors of `BayesianLDS`, and a q(z) that is coupled by them.

    A segment that starts in the middle of an episode has N(0, I) as the prior of its first state.
    """

    def __init__(self, settings: Dynamics, latent: int, task: TaskSettings, device: str) -> None:
        if task.observation.window != 1:
            raise UsageError(
                "dynamics.posterior = 'smoother' sees single frames: set task.observation.window = "
                f"1, not {task.observation.window}, or the posterior to 'mean-field'"
            )
        self.hidden = settings.hidden
        self.shown = latent
        super().__init__(settings, latent + settings.hidden, task, device)
        self.read_by = (self.factor, self.initial)
        """the factors that control's filter uses"""

    def _prior_mean(self, d: int, p: int) -> Float[Tensor, "d p"]:
        """Latents change little in one step; each hidden one is the velocity of a shown one."""
        mean = super()._prior_mean(d, p)
        mean[: self.shown, self.shown : d] = PACE * torch.eye(self.shown, self.hidden)
        return mean

    def _evidence(
        self, mean: Float[Tensor, "*batch shown"], variance: Float[Tensor, "*batch shown"]
    ) -> lds.Evidence:
        """What frames say of all latents: of hidden ones nothing."""
        shown = lds.Evidence.gaussian(mean, variance)
        pad = torch.nn.functional.pad
        return lds.Evidence(*(pad(part, (0, self.hidden)) for part in shown))

    def inferred(self, encoded: Segments) -> Segments:
        """Marginals of the chain, and what they cost; differentiable in what is encoded."""
        evidence = self._evidence(encoded.mean, encoded.variance)
        chain = lds.prior_chain(
            self._starts(encoded.start),
            self._dynamics(encoded),
            _inputs(encoded.actions),
            encoded.live,
        )
        if encoded.live is not None:
            evidence = lds.Evidence(*(part * encoded.live[..., None] for part in evidence))
        found = lds.smooth(chain.given(evidence))
        variance = found.covariance.diagonal(dim1=-2, dim2=-1)
        # E_q of the evidence's logarithm: all that q adds to the prior.
        second_moment = found.mean.square() + variance
        added = evidence.linear * found.mean - 0.5 * evidence.precision * second_moment
        return encoded._replace(
            mean=found.mean[..., : self.shown],
            variance=variance[..., : self.shown],
            smoothed=found,
            kl=added.sum((-2, -1)) - found.log_normaliser,
        )

    def sampled(
        self, encoded: Segments, noise: Float[Tensor, "S L shown"]
    ) -> tuple[Float[Tensor, "S L shown"], Segments]:
        """Of the marginal of what each frame shows."""
        doubles = encoded._replace(mean=encoded.mean.double(), variance=encoded.variance.double())
        posterior = self.inferred(doubles)
        assert posterior.smoothed is not None
        shown = posterior.smoothed.covariance[..., : self.shown, : self.shown]
        spread = torch.linalg.cholesky(shown) @ noise.double().unsqueeze(-1)
        return (posterior.mean + spread.squeeze(-1)).float(), posterior

    def _starts(self, start: Int[Tensor, " S"]) -> ExpectedStatistics:
        """The Gaussian of each segment's first state."""
        initial = mniw.expected_statistics(self.initial)
        eye = torch.eye(len(initial.precision)).to(initial.precision)
        zero = torch.zeros_like
        anywhere = ExpectedStatistics(eye, *(zero(part) for part in initial[1:]))
        begins = start == 0
        return ExpectedStatistics(
            *(
                torch.where(begins.view(-1, *[1] * own.ndim), own, other)
                for own, other in zip(initial, anywhere, strict=True)
            )
        )

    def _dynamics(self, segments: Segments) -> ExpectedStatistics:
        """Expectations of the map of each transition, or of the one of all."""
        expected = mniw.expected_statistics(self.factor)
        if self.settings.factors == "shared":
            return expected
        times = self._weights(segments)[0]
        return ExpectedStatistics(*(part[times] for part in expected))

    def statistics(self, segments: Segments) -> SmoothedStatistics:  # type: ignore[override]
        """Of a posterior; differentiable is the KL alone, for nothing else needs it."""
        assert segments.smoothed is not None
        assert segments.kl is not None
        with torch.no_grad():
            transitions, starts = self._expected(segments, segments.smoothed)
        count = len(segments.start) * segments.mean.shape[1]
        judged = count if segments.live is None else int(segments.live.sum())
        return SmoothedStatistics(segments.kl.sum(), transitions, starts, judged)

    def _expected(
        self, segments: Segments, of: lds.Smoothed
    ) -> tuple[RegressionStatistics, RegressionStatistics]:
        """Sums of the second moments of (z_{t+1}, [z_t; a; 1]) and of (z_0, 1)."""
        times, weights, start_weights = self._weights(segments)
        mean, covariance = of.mean, of.covariance
        x = torch.cat([mean[:, :-1], _inputs(segments.actions)], dim=-1)
        y = mean[:, 1:]
        if self.settings.factors == "shared":
            certain = mniw.regression_statistics(
                x.flatten(0, 1), y.flatten(0, 1), weights=weights.flatten()
            )
        else:
            # One "sample axis" of length 1 a transition, then summed by time step.
            single = mniw.regression_statistics(x[:, :, None], y[:, :, None])
            certain = RegressionStatistics(*(self._summed(p, times, weights) for p in single))
        yy, yz, zz = (
            self._summed(part, times, weights)
            for part in (covariance[:, 1:], of.cross.mT, covariance[:, :-1])
        )
        known = x.shape[-1] - y.shape[-1]
        pad = torch.nn.functional.pad
        transitions = certain.plus(
            RegressionStatistics(
                yy, pad(yz, (0, known)), pad(zz, (0, known, 0, known)), 0 * certain.n
            )
        )
        starts = niw.initial_statistics(mean[:, 0], weights=start_weights)
        uncertain = torch.einsum("s,sij->ij", start_weights, covariance[:, 0])
        return transitions, starts._replace(yy=starts.yy + uncertain)

    def _summed(
        self,
        values: Float[Tensor, "S n *rest"],
        times: Int[Tensor, "S n"],
        weights: Float[Tensor, "S n"],
    ) -> Float[Tensor, "*T rest"]:
        """Weighed sums over transitions: over all, or those of each time step."""
        if self.settings.factors == "shared":
            total: Tensor = torch.tensordot(weights, values, dims=2)
            return total
        weighed = values * weights.view(*weights.shape, *[1] * (values.ndim - 2))
        sums = torch.zeros(self.horizon, *values.shape[2:]).to(values)
        return sums.index_add(0, times.flatten(), weighed.flatten(0, 1))

    def kl(self, statistics: SmoothedStatistics) -> Tensor:  # type: ignore[override]
        """KL(q(z) || p(z)) with the expected log p, a frame."""
        return statistics.kl / statistics.judged

    @torch.no_grad()
    def conclude(self, episodes: Segments) -> None:
        """Coordinate ascent: the posterior of z, then that of the parameters, a few times."""
        for _ in range(ROUNDS if self.settings.closed_form else 1):
            super().conclude(self.inferred(episodes))

    @torch.no_grad()
    def given(self, episodes: Segments) -> RegressionStatistics:
        """The posterior over (F, Sigma) given ``episodes`` alone, as control sees their latents."""
        seen = self.read(episodes)
        certain = torch.zeros(*seen.shape, seen.shape[-1]).to(seen)
        of = lds.Smoothed(seen, certain, certain[:, 1:], seen.new_zeros(len(seen)))
        return self.prior.plus(self._expected(episodes, of)[0])

    def settle(self) -> None:
        """Filter with the factors of now."""
        self.read_by = (self.factor, self.initial)

    @torch.no_grad()
    def read(self, encoded: Segments) -> Float[Tensor, "S L d"]:
        """Means of the filter."""
        means, belief = [], None
        for t in range(encoded.mean.shape[1]):
            actions = encoded.actions[:, t - 1] if t else None
            mean, belief = self.follow(
                encoded.mean[:, t], encoded.variance[:, t], belief, actions, t
            )
            means.append(mean)
        return torch.stack(means, dim=1)

    def follow(
        self,
        mean: Float[Tensor, "N d"],
        variance: Float[Tensor, "N d"],
        belief: Any,
        actions: Float[Tensor, "N a"] | None,
        t: int,
    ) -> tuple[Float[Tensor, "N d"], lds.Belief]:
        """One step of the filter: what the last actions did, then what the frame says."""
        factor, initial = self.read_by
        if belief is None or actions is None:
            expected = lds.initial_belief(mniw.expected_statistics(initial))
        else:
            at = factor
            if self.settings.factors == "varying":
                at = RegressionStatistics(*(part[t - 1] for part in factor))
            expected = lds.predicted(belief, mniw.expected_statistics(at), _inputs(actions))
        found = expected.given(self._evidence(mean, variance))
        return found.mean, found

    def state_dict(self) -> dict[str, Any]:
        """Natural parameters of both factors, and of those that the filter uses."""
        return {**super().state_dict(), "read_by": [list(part) for part in self.read_by]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take them up."""
        super().load_state_dict(state)
        device = self.prior.yy.device
        factor, initial = (
            RegressionStatistics(*(part.to(device) for part in parts)) for parts in state["read_by"]
        )
        self.read_by = (factor, initial)


def _inputs(actions: Float[Tensor, "*batch a"]) -> Float[Tensor, "*batch a1"]:
    """[a; 1]."""
    return torch.cat([actions, torch.ones_like(actions[..., :1])], dim=-1)


def linear_dynamics(
    settings: Dynamics, latent: int, task: TaskSettings, device: str
) -> BayesianLDS:
    """SOLAR's prior, with the posterior that the settings name."""
    kind = SmoothedLDS if settings.posterior == "smoother" else BayesianLDS
    return kind(settings, latent, task, device)
