"""A learned representation as control uses it: trained, watched, repaired, and then embedded with.

A training can end with dead latents, or with some that say little of the costs: what it
reconstructs, and how well a quadratic of its latents explains the collected costs, each episode's
by a fit to others, tells. Then it is trained anew from other weights, a few times at most. Of
living ones the one that explains costs best is kept, of dead ones the one with the best ELBO of
episodes that it was not trained on. Nothing here sees an evaluation.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from solar_cli.episodes import Batch, Episodes
from solar_cli.errors import UsageError
from solar_cli.experience import Experience
from solar_cli.inference import mniw
from solar_cli.models.basis import LatentBasis, windows_of
from solar_cli.models.frames import FrameModel
from solar_cli.models.latent_model import LatentModel
from solar_cli.models.likelihoods import explained_variance
from solar_cli.models.priors import LatentPrior, Prior, Segments
from solar_cli.models.training import Trainer
from solar_cli.pulse import Pulse
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import LatentMethod
from solar_cli.stopwatch import Stopwatch
from solar_cli.streams import Streams

ACTIVE_SHARE = 0.9  # of a latent's variance that its mean must carry for it to count as active
LEAST_EXPLAINED = 0.4  # of the variance of each channel; a dead one has next to nothing
LEAST_COST_R2 = 0.1  # of the costs, else it is dead too
ENOUGH_COST_R2 = 0.7
"""of a first representation that is kept without trying other weights. SOLAR's are at .87 and more
on every task but Sawyer, where they differ as much between weights as between seeds. There eight of
the first twenty were below .7, and four of these started slowly; of those above one did later, at
.71"""
JUDGED_FRAMES = 600  # decoded at most to judge a batch: bounds memory

CostScore = Callable[["Representation", list[Episodes]], float]
"""R2 of the cost that control would fit on them, each episode left out once."""


class Candidate(NamedTuple):
    """One training of the representation, judged on held-out episodes."""

    alive: bool
    metrics: dict[str, float]
    parameters: dict[str, Any]

    @property
    def good_enough(self) -> bool:
        """Whether no other weights are tried."""
        return self.alive and self.metrics["held_out_cost_r2"] >= ENOUGH_COST_R2

    def rank(self) -> tuple[bool, float]:
        """Living ones by what they say of the costs, dead ones by their ELBO."""
        return self.alive, self.metrics["held_out_cost_r2" if self.alive else "held_out_elbo"]


class Representation:
    """Encoder, decoder and latent prior; `embed` gives the states that control works in."""

    def __init__(
        self,
        settings: LatentMethod,
        task: TaskSettings,
        make_prior: Callable[[], Prior],
        cost_score: CostScore,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.settings = settings
        self.task = task
        self.device = device
        self.moved_in = 0
        """the last iteration whose update changed what states mean; 0 before the first"""
        self._make_prior = make_prior
        self._cost_score = cost_score
        self._streams = streams
        self._pulse = pulse
        window, length = task.observation.window, settings.training.length
        if min(length, task.horizon + 1) <= window:
            raise UsageError(
                f"training.length = {length}, task.horizon = {task.horizon}: a segment and an "
                f"episode must be longer than the observation window of {window}; change one"
            )
        self._trainer = Trainer(settings.training, streams, device, pulse)
        self._model = self._untrained(0)
        self._basis: LatentBasis | None = None
        self._trained = False
        self._before: Candidate | None = None  # what a fine-tuning under way started from
        self._candidates: list[Candidate] = []
        self._latents: dict[Batch, Segments] = {}  # of the networks as they are
        self._watch = Stopwatch()  # of judging in this process: networks on collected episodes

    @property
    def trained(self) -> bool:
        """Whether there is something to embed with."""
        return self._trained

    @property
    def basis(self) -> LatentBasis:
        """From windows of latents to states; fixed after the first training."""
        assert self._basis is not None
        return self._basis

    def dynamics_prior(self, older: list[Episodes], *, as_it_stands: bool) -> LatentPrior:
        """What the model knows of its dynamics, for INFERDYNAMICS, on the CPU.

        Given ``older`` episodes, so that how much to trust it can be judged on the newest ones; or
        as it stands, given all that it was trained on (section 4.1 as printed).
        """
        factor = self._model.prior.factor if as_it_stands else None
        if older and not as_it_stands:
            factor = self._model.prior.given(self._encoded(older))
        if factor is not None:
            factor = mniw.RegressionStatistics(*(part.cpu() for part in factor))
        basis = LatentBasis(*(part.cpu() for part in self.basis))
        network = copy.deepcopy(self._model.prior.transition)
        return LatentPrior(factor, basis, self.latent, None if network is None else network.cpu())

    @property
    def latent(self) -> int:
        """d: latents of one time step."""
        return self.settings.representation.latent + self._model.prior.hidden

    @property
    def state_size(self) -> int:
        """z: entries of a state."""
        return self.latent * self.task.observation.window

    def update(self, experience: Experience) -> dict[str, float]:
        """MODELUPDATE (Algorithm 1, line 5): train on the batches of the last B iterations."""
        newest, recent = experience.recent(1), experience.recent(self.settings.training.buffer)
        self._watch.go_on_from({})
        if not self._trained:
            metrics = self._train_first(experience.iteration, newest)
        elif self.settings.training.fine_tune_steps:
            metrics = self._fine_tune(experience.iteration, newest, recent)
        else:
            metrics = self._judge(newest)
            self._conclude(recent)
        seconds = {"seconds_judging": self._watch.seconds().get("judging", 0.0)}
        return {**metrics, **self._model.prior.metrics(), **seconds}

    def _train_first(self, iteration: int, batches: list[Episodes]) -> dict[str, float]:
        """Train until a representation is good enough, or take the best of the attempts."""
        training, episodes = self.settings.training, Episodes.joined(batches)
        kept = max(1, round(training.held_out * len(episodes)))
        learned, held_out = episodes[:-kept], episodes[-kept:]
        while len(self._candidates) < training.attempts and not self._found():
            attempt = len(self._candidates)
            if not self._trainer.under_way:
                self._model = self._untrained(attempt)
                self._model.networks.standardise_by(self._live_frames(learned))
            name = f"attempt {attempt}"
            self._latents.clear()
            terms = self._trainer.fit(name, self._model, [learned], training.steps)
            encoded = self._encoded(batches).of(slice(-kept))
            self._model.prior.conclude(encoded)
            self._model.prior.settle()
            self._basis = self._whitening(encoded)
            metrics = self._judge([held_out])
            metrics["held_out_cost_r2"] = self._cost_score(self, batches)
            alive = self._alive(metrics) and metrics["held_out_cost_r2"] >= LEAST_COST_R2
            self._candidates.append(Candidate(alive, {**terms, **metrics}, self._parameters()))
        best = max(self._candidates, key=Candidate.rank)
        if not best.alive:
            warnings.warn(
                f"no representation of {len(self._candidates)} is alive; going on with the best: "
                f"it explains {best.metrics['least_explained_variance']:.0%} of a channel",
                stacklevel=2,
            )
        seconds = sum(candidate.metrics["seconds_training"] for candidate in self._candidates)
        discarded = {
            "alive": float(best.alive),
            "discarded_trainings": len(self._candidates) - 1.0,
            "seconds_discarded": seconds - best.metrics["seconds_training"],
        }
        self._take_up(best.parameters)
        self._trained, self.moved_in = True, iteration
        self._candidates = []
        return {**best.metrics, **discarded}

    def _found(self) -> bool:
        return any(candidate.good_enough for candidate in self._candidates)

    def _fine_tune(
        self, iteration: int, newest: list[Episodes], recent: list[Episodes]
    ) -> dict[str, float]:
        """Train further on the last batches; taken back if it kills what was alive."""
        steps = self.settings.training.fine_tune_steps
        if not self._trainer.under_way or self._before is None:
            self._before = Candidate(True, self._judge(newest), self._parameters())
        before = self._before
        name = f"iteration {iteration}"
        self._latents.clear()
        count = sum(len(episodes) for episodes in newest)
        terms = self._trainer.fit(name, self._model, recent, steps, newest=count)
        self._before = None
        self._conclude(recent)
        kills = self._alive(before.metrics) and not self._alive(self._judge(newest))
        if kills:
            self._take_up(before.parameters)
            self._conclude(recent)
        else:
            self._model.prior.settle()
            self.moved_in = iteration
        return {**terms, **before.metrics, "fine_tuning_taken_back": float(kills)}

    def _conclude(self, batches: list[Episodes]) -> None:
        self._model.prior.conclude(self._encoded(batches))

    @staticmethod
    def _alive(metrics: dict[str, float]) -> bool:
        """Whether every channel is reconstructed and something is encoded."""
        explained = metrics["least_explained_variance"] >= LEAST_EXPLAINED
        return explained and metrics["active_latents"] >= 1

    @torch.no_grad()
    def _judge(self, batches: list[Episodes]) -> dict[str, float]:
        """What there is to watch, on collected episodes that the model has not been trained on."""
        with self._watch.running("judging"):
            return self._held_out_metrics(batches)

    def _held_out_metrics(self, batches: list[Episodes]) -> dict[str, float]:
        model = self._model
        segments = model.prior.inferred(self._encoded(batches))
        mean, variance = segments.counted(segments.mean), segments.counted(segments.variance)
        some = slice(None, None, -(-len(mean) // JUDGED_FRAMES))
        frames = torch.cat([self._live_frames(episodes) for episodes in batches])
        scaled = model.networks.scaled(frames[some])
        draws = self._streams.generator("judging").standard_normal(mean[some].shape)
        sample = mean[some] + variance[some].sqrt() * torch.from_numpy(draws).to(mean)
        reconstruction = model.networks.reconstruction_loss(sample.float(), scaled)
        noise = self._streams.generator("judging", "transitions").standard_normal(
            segments.mean.shape
        )
        segments = segments._replace(noise=torch.from_numpy(noise).to(mean))
        statistics = model.prior.statistics(segments)
        kl = model.prior.kl(statistics)
        expected = model.networks.reconstruct(scaled, segments.decoded_from(mean[some]))
        explained = explained_variance(expected, scaled)
        spread = mean.var(dim=0)
        carried = spread / (spread + variance.mean(dim=0))
        return {
            "held_out_elbo": -float(reconstruction) - float(kl),
            "held_out_kl": float(kl),
            "least_explained_variance": float(explained.min()),
            "active_latents": float((carried >= ACTIVE_SHARE).sum()),
            **model.prior.judged(statistics),
        }

    @torch.no_grad()
    def embed(self, episodes: Episodes) -> Float[Tensor, "N T1 z"]:
        """States of every step; each frame is encoded once."""
        return self.basis.state(self._windows(self.latents(episodes)))

    @torch.no_grad()
    def latents(self, episodes: Episodes) -> Float[Tensor, "N T1 d"]:
        """Latents of every frame, from which states are made."""
        return self._model.prior.read(self._encoded([episodes]))

    @torch.no_grad()
    def follow(
        self,
        frames: np.ndarray[Any, Any],
        t: int,
        belief: Any,
        actions: Float[Tensor, "N a"] | None,
    ) -> tuple[Float[Tensor, "N d"], Any]:
        """Latents of the frames (N, *frame) of step ``t``, as ``latents`` gives them of all.

        The belief is what the step before returned, ``actions`` what was wanted then; both are None
        at the start.
        """
        tensor = torch.from_numpy(np.ascontiguousarray(frames)).to(self.device)
        mean, variance = self._model.embed(tensor)
        if actions is not None:
            bound = self.task.action.bound
            actions = actions.clamp(-bound, bound).to(self.device)  # as executed
        return self._model.prior.follow(mean, variance, belief, actions, t)

    @torch.no_grad()
    def reconstruct(self, episodes: Episodes) -> np.ndarray[Any, Any]:
        """Expected frames, in the shape and units of ``episodes.frames``."""
        networks = self._model.networks
        seen = torch.from_numpy(np.ascontiguousarray(episodes.frames))
        scaled = networks.scaled(seen.flatten(0, 1).to(self.device))
        segments = self._model.prior.inferred(self._encoded([episodes]))
        latents = segments.decoded_from(segments.mean.flatten(0, 1))
        frames = networks.as_frames(networks.reconstruct(scaled, latents))
        return frames.cpu().numpy().reshape(episodes.frames.shape)

    def state_dict(self) -> dict[str, Any]:
        """Networks, factors, basis, a training under way and the candidates so far."""
        return {
            "parameters": self._parameters(),
            "trainer": self._trainer.state_dict(),
            "candidates": [tuple(candidate) for candidate in self._candidates],
            "trained": self._trained,
            "moved_in": self.moved_in,
            "before": None if self._before is None else tuple(self._before),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""
        self._take_up(state["parameters"])
        self._trainer.load_state_dict(state["trainer"])
        self._candidates = [Candidate(*candidate) for candidate in state["candidates"]]
        self._trained, self.moved_in = state["trained"], state["moved_in"]
        self._before = None if state["before"] is None else Candidate(*state["before"])

    def _untrained(self, attempt: int) -> LatentModel:
        """Fresh networks whose weights depend on the seed and the attempt only."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self._streams.seed63("weights", attempt))
            networks = FrameModel(self.settings.representation, self.task.observation)
            prior = self._make_prior()
        return LatentModel(networks.to(self.device), prior, self.settings.training.standard_normal)

    def _encoded(self, batches: list[Episodes]) -> Segments:
        """Whole episodes as encoded; the same networks encode no collected frame twice."""
        return Segments.joined([self._encoded_by_batch(episodes) for episodes in batches])

    def _encoded_by_batch(self, episodes: Episodes) -> Segments:
        if episodes.batch in self._latents:
            return self._latents[episodes.batch]
        with self._watch.running("judging"):
            encoded = self._model.encoded(episodes, self.device)
        if episodes.batch is not None:
            self._latents[episodes.batch] = encoded
        return encoded

    def _live_frames(self, episodes: Episodes) -> Float[Tensor, "n *frame"]:
        return torch.from_numpy(episodes.frames[episodes.live_frames]).to(self.device)

    def _windows(self, latents: Float[Tensor, "N T1 d"]) -> Float[Tensor, "N T1 W d"]:
        return windows_of(latents, self.task.observation.window)

    def _whitening(self, encoded: Segments) -> LatentBasis:
        windows = encoded.counted(self._windows(self._model.prior.read(encoded)))
        if not self.settings.whitening:
            return LatentBasis.plain(windows)
        return LatentBasis.whitening(windows, self._model.prior.hidden)

    def _parameters(self) -> dict[str, Any]:
        networks = {
            name: value.detach().clone()
            for name, value in self._model.networks.state_dict().items()
        }
        basis = None if self._basis is None else list(self._basis)
        return {"networks": networks, "prior": self._model.prior.state_dict(), "basis": basis}

    def _take_up(self, parameters: dict[str, Any]) -> None:
        self._latents.clear()
        self._model.networks.load_state_dict(parameters["networks"])
        self._model.prior.load_state_dict(parameters["prior"])
        basis = parameters["basis"]
        self._basis = None if basis is None else LatentBasis(*(b.to(self.device) for b in basis))
