"""Robust locally linear controllable embedding (Banijamali et al. 2018) as a prior over latents.

The model of a transition: z, zbar ~ p(. | x), the encoder's Gaussian N(mu, diag sigma^2); the next
latents are z^ = A(zbar) z + C(zbar) e + B(zbar) u + o(zbar), and x' ~ p(x' | z^). With recognition
by q(z^ | x') q(zbar | x, z^), and z by the deterministic reverse transition, its bound is

    log p(x' | x, u) >= E log p(x' | z^) + H(q(z^ | x')) - E KL(q(zbar | x, z^) || p(zbar | x))
                        + E[log p(z | x) - log |det A(zbar)|],    z = A^-1 (z^ - C e - B u - o).

The determinant is that of the change of variables from z to z^. The first term is the observation
model's, of the same sample z^; the others are the KL terms here, by one sample a transition.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from solar_cli.models.networks import perceptron
from solar_cli.models.priors import MeanField, Segments, regressors
from solar_cli.models.transition import Local, TransitionNetwork, small_at_last
from solar_cli.pulse import Diverged
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import Transition
from solar_cli.streams import Streams

LOG_TWO_PI = math.log(2 * math.pi)


class Transitions(NamedTuple):
    """Those of segments: the encoder's Gaussians before and after. Axes: n transitions."""

    windows: Float[Tensor, "n Wd"]
    """means, of the newest frame first"""
    actions: Float[Tensor, "n a"]
    std: Float[Tensor, "n d"]
    """of the newest frame's"""
    later: Float[Tensor, "n d"]
    """means of the next frame's"""
    later_std: Float[Tensor, "n d"]

    @property
    def now(self) -> Local:
        """Where they start from, by the means."""
        return Local.of(self.windows, self.later.shape[-1], self.actions)

    def of(self, rows: Tensor) -> Transitions:
        """Some of them."""
        return Transitions(*(part[rows] for part in self))


class ControllableEmbedding(MeanField):
    """RCE's terms of the bound; q(z^ | x') is the encoder too, as p(z | x) is."""

    factor = None

    def __init__(
        self,
        settings: Transition,
        latent: int,
        task: TaskSettings,
        streams: Streams,
        device: str,
    ) -> None:
        self.settings = settings
        self.streams = streams
        self.concluded = 0
        self.window = window = task.observation.window
        self.transition = TransitionNetwork(
            settings, latent, window, task.action.size, task.exploration.std
        ).to(device)
        # From mu, log sigma, e and z^ to where zbar is likely, beginning with p(zbar | x).
        recognition = perceptron((window + 2) * latent, settings.recognition, 2 * latent)
        self.recognition = small_at_last(recognition, 0.0)
        self.recognition.to(device)

    def parameters(self) -> Iterable[nn.Parameter]:
        """Of both networks."""
        return [weight for network in self._networks().values() for weight in network.parameters()]

    def statistics(self, segments: Segments) -> Segments:
        """The segments as they are."""
        return segments

    def kl(self, statistics: Segments) -> Tensor:
        """The bound's terms but for the reconstruction, negative, nats a transition."""
        assert statistics.noise is not None
        # The noise of a frame's sample serves twice: for z^ of the transition to it, and for zbar
        # of the one from it. No term has both.
        noise = statistics.noise[:, self.window - 1 :]
        now, later = (statistics.counted(part) for part in (noise[:, :-1], noise[:, 1:]))
        return self._negative_bound(self._transitions(statistics), now, later)

    def _negative_bound(self, given: Transitions, now: Tensor, later: Tensor) -> Tensor:
        terms = self.terms(given.now, given.std, given.later + given.later_std * later, now)
        entropy = (given.later_std.log() + 0.5 * (1 + LOG_TWO_PI)).sum(dim=-1)
        bound: Tensor = (terms - entropy).mean()
        return bound

    def terms(
        self,
        now: Local,
        std: Float[Tensor, "n d"],
        successor: Float[Tensor, "n d"],
        noise: Float[Tensor, "n d"],
    ) -> Float[Tensor, " n"]:
        """KL(q(zbar | x, z^) || p(zbar | x)) - log p(z | x) + log |det A|, for a ``successor`` z^.

        p(. | x) is N(now.z, diag std^2); ``noise`` is standard normal, for the sample of zbar.
        """
        network = self.transition
        place, scaled = network.in_units(now), (successor - network.mean) / network.std
        std_in_units = std / network.std
        seen = torch.cat([place.z, std_in_units.log(), place.e, scaled], dim=-1)
        shift, log_ratio = self.recognition(seen).chunk(2, dim=-1)  # in units of p(zbar | x)'s std
        kl = 0.5 * (shift.square() + (2 * log_ratio).exp() - 1 - 2 * log_ratio).sum(dim=-1)
        zbar = place.z + std_in_units * (shift + log_ratio.exp() * noise)
        local = network.at(place._replace(z=zbar))
        z = network.plain(local.backward(scaled, place))
        density = -0.5 * (((z - now.z) / std).square() + 2 * std.log() + LOG_TWO_PI).sum(dim=-1)
        terms: Tensor = kl - density + local.A.log_determinant()
        return terms

    def _transitions(self, segments: Segments) -> Transitions:
        """All that count."""
        windows = regressors(segments.mean, self.window)[:, :-1]
        mean, std = (
            part[:, self.window - 1 :] for part in (segments.mean, segments.variance.sqrt())
        )
        actions = segments.actions[:, self.window - 1 :]
        parts = windows, actions, std[:, :-1], mean[:, 1:], std[:, 1:]
        return Transitions(*(segments.counted(part) for part in parts))

    @torch.no_grad()
    def learn(self, statistics: Segments, scale: float) -> None:
        """Adam trains the networks; their units follow the latents."""
        given = self._transitions(statistics)
        self.transition.track(given.now, given.std.square().mean(dim=0))

    def conclude(self, episodes: Segments) -> None:
        """Fit both networks further to all ``episodes``, with latents as they are."""
        settings, given = self.settings, self._transitions(episodes)
        if not self.transition.seen:  # true states were given, and nothing was trained
            self.learn(episodes, 1.0)
        optimiser = torch.optim.Adam(self.parameters(), lr=settings.rate)
        for step in range(settings.steps):
            for group in optimiser.param_groups:
                group["lr"] = settings.rate * 0.5 * (1 + math.cos(math.pi * step / settings.steps))
            stream = self.streams.generator("conclusion", self.concluded, step)
            rows = torch.from_numpy(stream.integers(len(given.later), size=settings.batch))
            batch = given.of(rows.to(given.later.device))
            noise = torch.from_numpy(stream.standard_normal((2, *batch.later.shape)))
            loss = self._negative_bound(batch, *noise.to(given.later))
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            optimiser.step()
            if not math.isfinite(loss.item()):
                raise Diverged(f"step {step + 1} of fitting transitions: the loss is not finite")
        self.concluded += 1

    def given(self, episodes: Segments) -> None:
        """No factor over dynamics."""

    @torch.no_grad()
    def judged(self, statistics: Segments) -> dict[str, float]:
        """R2 of the next latents less the present ones, both by the encoder's mean."""
        given = self._transitions(statistics)
        predicted = self.transition(given.windows, given.actions)
        moved = given.later - given.now.z
        spread = (moved - moved.mean(dim=0)).square().sum().clamp_min(1e-12)
        return {"transition_r2": 1 - float((predicted - given.later).square().sum() / spread)}

    def metrics(self) -> dict[str, float]:
        """Nothing that is not a metric of training."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Weights of both networks, the units, and how often they were fitted."""
        weights = {
            name: {key: value.detach().clone() for key, value in network.state_dict().items()}
            for name, network in self._networks().items()
        }
        return {**weights, "concluded": self.concluded}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take them up."""
        for name, network in self._networks().items():
            network.load_state_dict(state[name])
        self.concluded = state["concluded"]

    def _networks(self) -> dict[str, nn.Module]:
        return {"transition": self.transition, "recognition": self.recognition}
