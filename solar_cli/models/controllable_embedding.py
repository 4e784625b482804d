"""Robust locally linear controllable embedding (Banijamali et al. 2018) as a prior over latents.

The model of a transition: z, zbar ~ p(. | x), the encoder's Gaussian N(mu, diag sigma^2); the next
latents are z^ = A(zbar) z + C(zbar) e + B(zbar) u + o(zbar), and x' ~ p(x' | z^). With the recognition
q(z^ | x') q(zbar | x, z^), and z by the deterministic reverse transition, its bound is

    log p(x' | x, u) >= E log p(x' | z^) + H(q(z^ | x')) - E KL(q(zbar | x, z^) || p(zbar | x))
                        + E[log p(z | x) - log |det A(zbar)|],    z = A^-1 (z^ - C e - B u - o).

The determinant is that of the change of variables from z to z^. The first term is the observation
model's, of the same sample z^; the others are the KL terms here, by one sample a transition.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from solar_cli.models.priors import Segments, regressors
from solar_cli.models.transition import Local, TransitionNetwork, perceptron
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import Transition


LOG_TWO_PI = math.log(2 * math.pi)


class ControllableEmbedding:
    """RCE's terms of the bound; q(z^ | x') is the encoder too, as p(z | x) is."""

    factor = None

    def __init__(
        self, settings: Transition, latent: int, task: TaskSettings, device: str
    ) -> None:
        self.window = window = task.observation.window
        self.transition = TransitionNetwork(
            settings, latent, window, task.action.size, task.exploration.std
        ).to(device)
        # From mu, log sigma, e and z^ to where zbar is likely, beginning with p(zbar | x).
        self.recognition = perceptron((window + 2) * latent, settings.recognition, 2 * latent, 0.0)
        self.recognition.to(device)

    def parameters(self) -> Iterable[nn.Parameter]:
        """Of both networks."""
        return [weight for network in self._networks().values() for weight in network.parameters()]

    def statistics(self, segments: Segments) -> Segments:
        """The segments as they are."""
        return segments

    def kl(self, statistics: Segments) -> Tensor:
        """The bound's terms but for the reconstruction, negative, nats a transition."""
        mean, variance, noise = statistics.mean, statistics.variance, statistics.noise
        assert noise is not None
        now, later = slice(self.window - 1, -1), slice(self.window, None)
        std = variance.sqrt()
        successor = (mean + std * noise)[:, later]
        # The noise of a frame's sample serves twice: for z^ of the transition to it, and for zbar
        # of the one from it. No term has both.
        terms = self.terms(
            self._moves(statistics),
            std[:, now].flatten(0, 1),
            successor.flatten(0, 1),
            noise[:, now].flatten(0, 1),
        ).view(successor.shape[:2])
        entropy = 0.5 * (variance[:, later].log() + 1 + LOG_TWO_PI).sum(dim=-1)
        return statistics.counted(terms - entropy).mean()

    def terms(
        self,
        now: Local,
        std: Float[Tensor, "n d"],
        successor: Float[Tensor, "n d"],
        noise: Float[Tensor, "n d"],
    ) -> Float[Tensor, " n"]:
        """KL(q(zbar | x, z^) || p(zbar | x)) - log p(z | x) + log |det A| for samples z^ = successor.

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
        return kl - density + local.A.log_determinant()

    def _moves(self, segments: Segments) -> Local:
        """What there is at each transition, by the encoder's mean."""
        actions = segments.actions[:, self.window - 1 :].flatten(0, 1)
        return Local.of(self._windows(segments).flatten(0, 1), segments.mean.shape[-1], actions)

    def _windows(self, segments: Segments) -> Float[Tensor, "S n Wd"]:
        """Of each transition's present."""
        return regressors(segments.mean, self.window)[:, :-1]

    def learn(self, statistics: Segments, scale: float) -> None:
        """Adam trains the networks; their units follow the latents."""
        variance = statistics.counted(statistics.variance).mean(dim=0)
        self.transition.track(self._moves(statistics), variance)

    def conclude(self, episodes: Segments) -> None:
        """Nothing in closed form."""

    def given(self, episodes: Segments) -> None:
        """No factor over dynamics."""

    def judged(self, statistics: Segments) -> dict[str, float]:
        """R2 of the next latents less the present ones, both by the encoder's mean."""
        windows = self._windows(statistics)
        actions = statistics.actions[:, self.window - 1 :]
        predicted = self.transition(windows.flatten(0, 1), actions.flatten(0, 1))
        mean = statistics.mean[:, self.window - 1 :]
        left = statistics.counted(predicted.view_as(mean[:, 1:]) - mean[:, 1:])
        moved = statistics.counted(mean.diff(dim=1))
        spread = (moved - moved.mean(dim=0)).square().sum()
        return {"transition_r2": 1 - float(left.square().sum() / spread.clamp_min(1e-12))}

    def metrics(self) -> dict[str, float]:
        """Nothing that is not a metric of training."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Weights of both networks, and the units."""
        return {
            name: {key: value.detach().clone() for key, value in network.state_dict().items()}
            for name, network in self._networks().items()
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take them up."""
        for name, network in self._networks().items():
            network.load_state_dict(state[name])

    def _networks(self) -> dict[str, nn.Module]:
        return {"transition": self.transition, "recognition": self.recognition}
