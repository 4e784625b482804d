"""Training of a latent model: stochastic gradients for networks, natural ones for the prior."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from solar_cli.episodes import Episodes
from solar_cli.errors import SolarError
from solar_cli.models.descent import Descent
from solar_cli.models.latent_model import LatentModel, Minibatch
from solar_cli.pulse import Diverged, Pulse
from solar_cli.settings.local import Training
from solar_cli.streams import Streams

PULSE_STEPS = 20
SMOOTHING = 0.98  # of the ELBO terms that are reported: an average over about 50 steps


class Trainer(Descent):
    """Runs `LatentModel.loss` for a number of steps on batches of episodes."""

    def __init__(self, settings: Training, streams: Streams, device: str, pulse: Pulse) -> None:
        super().__init__("training the model", PULSE_STEPS, pulse)
        self.settings = settings
        self.streams = streams
        self.device = device

    def fit(
        self,
        name: str,
        model: LatentModel,
        batches: list[Episodes],
        steps: int,
        *,
        newest: int = 0,
    ) -> dict[str, float]:
        """Train for ``steps`` steps; smoothed ELBO terms. The prior is to be concluded then.

        ``name`` keys the run's random draws; a run of that name that was interrupted goes on.
        When fine-tuning, half of the segments come from the ``newest`` episodes, the last ones.
        """
        data, fine_tuning = Dataset(batches, self.device, newest), newest > 0
        optimiser = torch.optim.Adam(model.parameters(), lr=self.settings.learning_rate, fused=True)
        latent = model.networks.settings.latent

        def rate(share: float) -> float:
            return self._rate(share, fine_tuning)

        for step in self.steps(name, optimiser, steps, rate, terms={}):
            draws = self.streams.generator("minibatch", name, step.number)
            batch = data.minibatch(self.settings, draws, latent)
            weight = self.settings.kl_end if fine_tuning else self._kl_weight(step.share)
            try:
                loss, statistics, terms = model.loss(batch, weight)
                self.descend(loss, self.settings.clip)
                model.prior.learn(statistics, data.scale(batch))
            except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
                raise Diverged(f"{self.place}: {error}") from error
            self._smooth(self.record["terms"], terms)
        record = self.end()
        smoothed = {term: float(value) for term, value in record["terms"].items()}
        return {**smoothed, "seconds_training": record["seconds"]}

    def _rate(self, share: float, fine_tuning: bool) -> float:
        if fine_tuning:
            return self.settings.fine_tune_rate
        if self.settings.schedule == "constant":
            return self.settings.learning_rate
        return self.settings.learning_rate * 0.5 * (1 + math.cos(math.pi * share))

    def _kl_weight(self, share: float) -> float:
        """Held at first, then a linear rise: a KL term from the start collapses the latents."""
        settings = self.settings
        rise = (share - settings.kl_hold) / settings.kl_ramp if settings.kl_ramp else math.inf
        rise = min(max(rise, 0.0), 1.0) if share >= settings.kl_hold else 0.0
        return settings.kl_start + rise * (settings.kl_end - settings.kl_start)

    @staticmethod
    def _smooth(terms: dict[str, Tensor], new: dict[str, Tensor]) -> None:
        for name, value in new.items():
            # Kept as tensors: reading a number would wait for the device at every step.
            value = value.detach().double()
            old = terms.get(name)
            terms[name] = value if old is None else SMOOTHING * old + (1 - SMOOTHING) * value

    def state_dict(self) -> dict[str, Any]:
        """A run that is under way: its step, smoothed terms and optimiser."""
        state = super().state_dict()
        return {**state, "terms": dict(state["terms"])} if state else {}


class Dataset:
    """Batches of episodes on the device, and minibatches of segments from them.

    Segments are of live steps only; an episode that ended before it was as long as one has none.
    """

    def __init__(self, batches: list[Episodes], device: str, newest: int = 0) -> None:
        self.device = device
        self.episodes = Episodes.joined(batches)
        self.newest = newest
        if (longest := self.episodes.lengths.max()) < self.episodes.window:
            raise SolarError(
                f"none of {len(self.episodes)} episodes lasts longer than {longest} steps: there "
                f"is no transition between windows of {self.episodes.window} frames to learn from; "
                "choose a smaller window, or exploration that ends episodes later"
            )
        self.frames = torch.from_numpy(self.episodes.frames).to(device).flatten(0, 1)
        self.actions = torch.from_numpy(self.episodes.actions).to(device).flatten(0, 1)

    def minibatch(self, settings: Training, stream: np.random.Generator, latent: int) -> Minibatch:
        """Random segments, half of them from the ``newest`` episodes where there are any."""
        length = min(settings.length, int(self.episodes.lengths.max()) + 1)
        segments = settings.segments
        firsts = self._firsts(length)
        # Each episode as often as it has segments, which are then equally likely.
        often = firsts // np.gcd.reduce(firsts)
        tickets = np.repeat(np.arange(len(firsts)), often)
        drawn = stream.integers(len(tickets), size=segments)
        if self.newest and (newest := int(often[-self.newest :].sum())):
            half = segments // 2
            drawn[:half] = len(tickets) - 1 - stream.integers(newest, size=half)
        rows = tickets[drawn]
        starts = stream.integers(firsts[rows])
        noise = stream.standard_normal((segments, length, latent), dtype=np.float32)
        decoded = stream.permutation(segments * length)
        decoded = decoded[: max(1, round(settings.decoded * segments * length))]
        horizon = self.episodes.horizon
        whole = firsts.min() == horizon + 2 - length
        places = (rows * (horizon + 1) + starts)[:, None] + np.arange(length)
        moves = (rows * horizon + starts)[:, None] + np.arange(length - 1)
        return Minibatch(
            self._taken(self.frames, places),
            self._taken(self.actions, moves),
            torch.from_numpy(starts).to(self.device),
            torch.from_numpy(noise).to(self.device),
            torch.from_numpy(decoded).to(self.device),
            None if whole else torch.from_numpy(firsts[rows]).to(self.device),
        )

    def _taken(self, flat: Tensor, places: NDArray[np.int64]) -> Tensor:
        """Entries (S, n, ...) of an array whose episodes lie end to end."""
        chosen = flat.index_select(0, torch.from_numpy(places.ravel()).to(self.device))
        return chosen.view(*places.shape, *flat.shape[1:])

    def scale(self, batch: Minibatch) -> float:
        """B of Eq. 6: episodes that a segment of the minibatch stands for."""
        segments, length = batch.frames.shape[:2]
        starts = self.episodes.horizon + 2 - length
        return float(self._firsts(length).sum() / starts / segments)

    def _firsts(self, length: int) -> NDArray[np.int64]:
        """(N,) segments of ``length`` frames that each episode has."""
        return np.asarray(np.maximum(self.episodes.lengths + 2 - length, 0))
