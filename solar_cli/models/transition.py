"""Locally linear transitions of latents: z' = A z + C e + B u + o, all functions of the place.

E2C's network (Watter et al. 2015) with A = I + v r^T. What a window of frames adds are the
differences e of its latents, a function of what was observed: given them, A still maps the newest
latents to the next, and is near I though latents have a velocity.

Axes: n samples, d latents of a frame, W frames of a window, r = (W - 1) d differences, a actions.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from solar_cli.models.networks import perceptron
from solar_cli.settings.local import Transition

TRACKING = 0.02  # of the latents' mean and std, a step of training: an average over about 50
SMALL = 0.1  # of the last layer's first weights: A starts near I, for latents change little a step


class Local(NamedTuple):
    """Places or moves: newest latents, differences back through the window, actions."""

    z: Float[Tensor, "n d"]
    e: Float[Tensor, "n r"]
    u: Float[Tensor, "n a"]

    @staticmethod
    def of(windows: Float[Tensor, "n Wd"], d: int, actions: Float[Tensor, "n a"]) -> Local:
        """Of windows with the newest latents first."""
        return Local(windows[:, :d], windows[:, :-d] - windows[:, d:], actions)


class RankOne(NamedTuple):
    """A = I + v r^T."""

    v: Float[Tensor, "n d"]
    r: Float[Tensor, "n d"]

    def times(self, z: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
        """A z."""
        return z + self.v * (self.r * z).sum(dim=-1, keepdim=True)

    def solve(self, z: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
        """A^-1 z = z - v (r^T z) / (1 + r^T v), as Sherman and Morrison have it."""
        along = (self.r * z).sum(dim=-1) / self._determinant()
        return z - self.v * along.unsqueeze(-1)

    def log_determinant(self) -> Float[Tensor, " n"]:
        """log |det A| = log |1 + r^T v|."""
        return self._determinant().abs().log()

    def _determinant(self) -> Float[Tensor, " n"]:
        return 1 + (self.r * self.v).sum(dim=-1)


class Coefficients(NamedTuple):
    """The transition at each of n places."""

    A: RankOne
    C: Float[Tensor, "n d r"]
    B: Float[Tensor, "n d a"]
    o: Float[Tensor, "n d"]

    def forward(self, now: Local) -> Float[Tensor, "n d"]:
        """z' = A z + C e + B u + o."""
        return self.A.times(now.z) + self._moved(now)

    def backward(self, successor: Float[Tensor, "n d"], now: Local) -> Float[Tensor, "n d"]:
        """z = A^-1 (z' - C e - B u - o); ``now.z`` is not used."""
        return self.A.solve(successor - self._moved(now))

    def _moved(self, now: Local) -> Float[Tensor, "n d"]:
        products = self.C @ now.e.unsqueeze(-1) + self.B @ now.u.unsqueeze(-1)
        return products.squeeze(-1) + self.o


class TransitionNetwork(nn.Module):
    """One network from places to coefficients, which act on latents in units of their own std."""

    mean: Tensor
    std: Tensor
    difference_std: Tensor
    action_std: Tensor
    seen: Tensor

    def __init__(
        self, settings: Transition, latent: int, window: int, actions: int, action_std: float
    ) -> None:
        super().__init__()
        differences = (window - 1) * latent
        self.shapes = ((latent,), (latent,), (latent, differences), (latent, actions), (latent,))
        outputs = sum(torch.Size(shape).numel() for shape in self.shapes)
        layers = perceptron(latent + differences, settings.hidden, outputs)
        self.layers = small_at_last(layers, SMALL)
        for name, value in {
            "mean": torch.zeros(latent, dtype=torch.float64),
            "std": torch.ones(latent, dtype=torch.float64),
            "difference_std": torch.ones(differences, dtype=torch.float64),
            "action_std": torch.tensor(action_std, dtype=torch.float64),
        }.items():
            self.register_buffer(name, value)
        self.register_buffer("seen", torch.zeros((), dtype=torch.long))

    @torch.no_grad()
    def track(self, latents: Local, variance: Float[Tensor, " d"]) -> None:
        """Move the units towards these latents' mean and std, for they change while training.

        ``latents`` are means of factors, ``variance`` is that of the factors: before the encoder
        tells frames apart, it is all there is.
        """
        self.seen += 1
        rate = (1 / self.seen).clamp_min(TRACKING).double()
        self.mean.lerp_(latents.z.mean(dim=0), rate)
        self.std.lerp_((latents.z.var(dim=0) + variance).sqrt(), rate)
        differences = latents.e.square().mean(dim=0).view(-1, len(variance))
        self.difference_std.lerp_((differences + variance).sqrt().flatten(), rate)

    def in_units(self, plain: Local) -> Local:
        """Of latents as encoded."""
        z = (plain.z - self.mean) / self.std
        return Local(z, plain.e / self.difference_std, plain.u / self.action_std)

    def plain(self, z: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
        """Latents as encoded, of those in units of their std."""
        return self.mean + self.std * z

    def at(self, place: Local) -> Coefficients:
        """Coefficients at a place in units; its action is not looked at."""
        sizes = [torch.Size(shape).numel() for shape in self.shapes]
        parts = self.layers(torch.cat([place.z, place.e], dim=-1)).split(sizes, dim=-1)
        v, r, C, B, o = (
            part.reshape(len(place.z), *shape)
            for part, shape in zip(parts, self.shapes, strict=True)
        )
        return Coefficients(RankOne(v, r), C, B, o)

    def forward(
        self, windows: Float[Tensor, "n Wd"], actions: Float[Tensor, "n a"]
    ) -> Float[Tensor, "n d"]:
        """The next latents, as encoded, after windows with the newest latents first."""
        now = self.in_units(Local.of(windows, len(self.mean), actions))
        return self.plain(self.at(now).forward(now))

    @torch.no_grad()
    def slopes(
        self, windows: Float[Tensor, "n Wd"], actions: Float[Tensor, "n a"]
    ) -> tuple[Float[Tensor, "n d Wd"], Float[Tensor, "n d a"]]:
        """Derivatives of the next latents by windows and by actions.

        The whole ones: that A, B, C and o are others nearby counts too.
        """

        def after(window: Tensor, action: Tensor) -> Tensor:
            successor: Tensor = self(window.unsqueeze(0), action.unsqueeze(0))
            return successor.squeeze(0)

        jacobian = torch.func.jacrev(after, argnums=(0, 1))
        of_windows, of_actions = torch.func.vmap(jacobian)(windows, actions)
        return of_windows, of_actions


def small_at_last(layers: nn.Sequential, share: float) -> nn.Sequential:
    """In float64, with the last layer's first weights scaled by ``share``."""
    last = layers[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight.mul_(share)
        last.bias.mul_(share)
    return layers.double()
