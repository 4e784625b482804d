"""The one fit of neural models to episodes: dynamics, and where it is to be learned, the cost.

Part of each batch of episodes is held out: it says which step's parameters are kept, and how good
they are.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from solar_cli.models.descent import Descent
from solar_cli.models.neural import (
    NeuralCost,
    NeuralDynamics,
    Segment,
    Sequences,
    cost_r2,
    prediction_r2,
)
from solar_cli.pulse import Diverged, Pulse
from solar_cli.settings.neural import NeuralFit
from solar_cli.streams import Streams

JUDGED_STEPS = 50
"""gradient steps between two looks at held-out episodes, and two pulses"""
JUDGED_SEGMENTS = 4096


class NeuralModel(nn.Module):
    """Dynamics, and a cost that is learned or None."""

    standardised: Tensor

    def __init__(self, dynamics: NeuralDynamics, cost: NeuralCost | None) -> None:
        super().__init__()
        self.dynamics, self.cost = dynamics, cost
        self.entries = len(dynamics.change.x_mean) + dynamics.newest  # of the noise of a segment
        self.register_buffer("standardised", torch.tensor(False))

    @property
    def fitted(self) -> bool:
        """Whether it has been shown anything."""
        return bool(self.standardised)

    def standardise_by(self, seen: Sequences) -> None:
        """Take all scales from episodes, the first ones that there are."""
        segment, d = seen.segments(*seen.starts(1), 1), self.dynamics.newest
        states = segment.states[:, 0]
        change = segment.states[:, 1, :d] - states[:, :d]
        self.dynamics.change.standardise_by(
            torch.cat([states, segment.actions[:, 0]], dim=-1), change
        )
        if self.cost is not None:
            self.cost.standardise_by(states[:, : self.cost.newest], segment.costs)
        self.standardised.fill_(True)

    def loss(self, segment: Segment, noise: Tensor | None = None) -> Tensor:
        """Squared errors in units of the targets' std: of newest blocks, and of costs.

        Each step's prediction is the next one's input; ``noise`` (n, i + d) is added to what the
        first step is made from, and to what it is compared with.
        """
        dynamics, d = self.dynamics, self.dynamics.newest
        scale = dynamics.change
        states, actions = segment.states[:, 0], segment.actions
        targets = segment.states[:, 1:, :d]
        errors = []
        for k in range(actions.shape[1]):
            action, target = actions[:, k], targets[:, k]
            start = states[:, :d]
            if noise is not None and k == 0:
                inputs = torch.cat([states, action], dim=-1) + noise[:, :-d] * scale.x_std
                change = scale(inputs)
                target = target + noise[:, -d:] * scale.y_std
            else:
                change = dynamics.changes(states, action)
            errors.append((start + change - target) / scale.y_std)
            states = dynamics.follow(states, change)
        total = torch.stack(errors).square().mean()
        if self.cost is not None:
            wrong = (self.cost.of(segment.states[:, :-1]) - segment.costs) / self.cost.y_std
            total = total + wrong.square().mean()
        return total


class NeuralTrainer(Descent):
    """Adam on `NeuralModel.loss`; the parameters that held-out segments like best are kept."""

    def __init__(self, settings: NeuralFit, streams: Streams, pulse: Pulse) -> None:
        super().__init__("training the networks", JUDGED_STEPS, pulse)
        self.settings = settings
        self.streams = streams

    def fit(
        self,
        name: str,
        model: NeuralModel,
        batches: list[Sequences],
        explored: int,
        horizon: int,
    ) -> dict[str, float]:
        """Fit to batches, ``explored`` first ones of plain noise; R2 of held-out episodes.

        ``name`` keys the random draws; a fit of that name that was interrupted goes on.
        """
        share = self.settings.held_out
        split = [max(1, min(round(share * len(batch)), len(batch) - 1)) for batch in batches]
        learned = [batch.some(slice(None, -k)) for batch, k in zip(batches, split, strict=True)]
        kept = [batch.some(slice(-k, None)) for batch, k in zip(batches, split, strict=True)]
        held_out = Sequences.joined(kept)
        seen = Sequences.joined(learned)
        if not model.fitted:
            model.standardise_by(seen)
        steps = min(self.settings.unroll, seen.longest, held_out.longest)
        old = sum(len(batch) for batch in learned[:explored])
        draws = Minibatches(seen, old, steps, model.entries, self.settings)
        judged = held_out.segments(*_thinned(*held_out.starts(steps)), steps)
        self._train(name, model, draws, judged)
        metrics = {
            "one_step_r2": prediction_r2(model.dynamics, held_out, 1),
            "horizon_r2": prediction_r2(model.dynamics, held_out, horizon),
        }
        if model.cost is not None:
            metrics["cost_r2"] = cost_r2(model.cost, held_out)
        record = self.end()
        return {
            "held_out_loss": record["least"],
            "kept_step": float(record["kept_step"]),
            "seconds_training": record["seconds"],
            **metrics,
        }

    def _train(self, name: str, model: NeuralModel, draws: Minibatches, judged: Segment) -> None:
        settings = self.settings
        optimiser = torch.optim.Adam(model.parameters(), lr=settings.learning_rate)
        for step in self.steps(
            name, optimiser, settings.steps, self._rate, least=math.inf, kept={}, kept_step=0
        ):
            if step.number == 0:  # what there was before is kept where nothing beats it
                self._judge(model, judged, 0)
            segment, noise = draws.draw(self.streams.generator(name, step.number))
            self.descend(model.loss(segment, noise))
            if step.pausing:
                self._judge(model, judged, step.number + 1)
        model.load_state_dict(self.record["kept"])

    def _rate(self, share: float) -> float:
        rate = self.settings.learning_rate
        if self.settings.schedule == "constant":
            return rate
        return rate * 0.5 * (1 + math.cos(math.pi * share))

    @torch.no_grad()
    def _judge(self, model: NeuralModel, judged: Segment, step: int) -> None:
        """Keep the parameters of now, where held-out segments say that they are the best."""
        loss = float(model.loss(judged))
        if not math.isfinite(loss):
            name = self.record["name"]
            raise Diverged(f"step {step} of {name}: the loss is not finite")
        if loss < self.record["least"]:
            kept = {name: value.clone() for name, value in model.state_dict().items()}
            self.record.update(least=loss, kept=kept, kept_step=step)


class Minibatches:
    """Random segments of what is learned from, the first ``explored`` episodes of it of noise."""

    def __init__(
        self, seen: Sequences, explored: int, steps: int, entries: int, settings: NeuralFit
    ) -> None:
        self.seen, self.steps, self.settings = seen, steps, settings
        self.episode, self.step = seen.starts(steps)
        self.old = int((self.episode < explored).sum())
        self.entries = entries

    def draw(self, stream: np.random.Generator) -> tuple[Segment, Tensor | None]:
        """Segments, and noise where settings ask for it."""
        settings, count, old = self.settings, len(self.episode), self.old
        rows = stream.integers(count, size=settings.batch)
        if settings.new != "alike" and 0 < old < count:
            fresh = round(settings.new * settings.batch)
            rows[:fresh] = stream.integers(old, count, size=fresh)
            rows[fresh:] = stream.integers(old, size=settings.batch - fresh)
        chosen = torch.from_numpy(rows).to(self.episode.device)
        segment = self.seen.segments(self.episode[chosen], self.step[chosen], self.steps)
        if settings.noise == 0:
            return segment, None
        noise = stream.standard_normal((settings.batch, self.entries), dtype=np.float32)
        return segment, settings.noise * torch.from_numpy(noise).to(segment.states)


def _thinned(episode: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    some = slice(None, None, -(-len(episode) // JUDGED_SEGMENTS))
    return episode[some], step[some]
