"""The recognition model q(z | s) and the observation model p(s | z), frame by frame (section 3)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from solar_cli.errors import UsageError
from solar_cli.models.likelihoods import UNCALIBRATED, calibrated, mean_frame
from solar_cli.models.networks import build
from solar_cli.settings.local import Representation
from solar_cli.settings.task import Observation

INITIAL_LOG_VARIANCE = -4.0
CHUNK = 512  # frames in floating point at once: bounds memory, loses no speed
LOG_VARIANCE_RANGE = (-14.0, 4.0)  # beyond it a float32 KL term overflows its gradient


class FrameModel(nn.Module):
    """Both networks and the scaling of frames; windows are made of frames' latents elsewhere.

    Frames (n, *frame) come as stored: uint8 images or float32 states.
    """

    frame_mean: Tensor
    frame_scale: Tensor

    def __init__(self, settings: Representation, observation: Observation) -> None:
        super().__init__()
        self.settings = settings
        self.observation = observation
        shape = observation.frame_shape
        if settings.likelihood == "categorical" and observation.kind != "image":
            raise UsageError("a categorical likelihood needs images; choose another for states")
        if settings.likelihood in ("bernoulli", "categorical") and settings.input != "unit":
            raise UsageError(
                f"representation.likelihood = {settings.likelihood!r} needs frames in [0, 1]: set "
                "representation.input = 'unit'"
            )
        self.register_buffer("frame_mean", torch.zeros(shape))
        self.register_buffer(
            "frame_scale", torch.ones(() if observation.kind == "image" else shape)
        )
        self.body, features = build(settings.encoder, shape)
        width = math.prod(features)
        if settings.head == "none":
            if width != settings.latent:
                raise UsageError(
                    f"representation.head = 'none' needs an encoder with {settings.latent} outputs "
                    f"(representation.latent), this one has {width}"
                )
            self.mean: nn.Module = nn.Flatten()
        else:
            self.mean = nn.Sequential(nn.Flatten(), nn.Linear(width, settings.latent))
        if settings.variance == "learned":
            log_variance = nn.Linear(width, settings.latent)
            nn.init.zeros_(log_variance.weight)
            nn.init.constant_(log_variance.bias, INITIAL_LOG_VARIANCE)
            self.log_variance: nn.Module | None = nn.Sequential(nn.Flatten(), log_variance)
        else:
            self.log_variance = None
        hidden, last = build(settings.decoder, (settings.latent,), shape)
        # A decoder that ends in a frame is complete; otherwise one linear layer makes the frame.
        rectified = (
            getattr(settings.decoder[-1] if settings.decoder else None, "activation", "none")
            != "none"
        )
        if last == shape and not rectified:
            self.decoder = hidden
        else:
            self.decoder = nn.Sequential(
                *hidden,
                *([nn.Flatten()] if len(last) > 1 else []),
                nn.Linear(math.prod(last), math.prod(shape)),
                nn.Unflatten(1, shape),
            )

    def standardise_by(self, frames: Tensor) -> None:
        """Take mean image and pixel scale from collected frames (n, *frame)."""
        if self.settings.input == "standardised":
            count, chunks = len(frames), torch.split(frames, CHUNK)
            mean = torch.stack([chunk.double().sum(dim=0) for chunk in chunks]).sum(dim=0) / count
            squares = [(chunk - mean).square().sum(dim=0) for chunk in chunks]
            variance = torch.stack(squares).sum(dim=0) / count
            self.frame_mean.copy_(mean)
            if self.observation.kind == "image":
                self.frame_scale.copy_(variance.mean().sqrt().clamp_min(1e-6))
            else:  # entries of a state have units of their own; a constant one stays zero
                scale = variance.sqrt()
                self.frame_scale.copy_(torch.where(scale > 1e-6, scale, 1.0))
        elif self.observation.kind == "image":
            self.frame_scale.fill_(255.0)

    def scaled(self, frames: Tensor) -> Float[Tensor, "n *frame"]:
        """Frames as the networks see them."""
        return (frames.float() - self.frame_mean) / self.frame_scale

    def encode(
        self, scaled: Float[Tensor, "n *frame"]
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d"]]:
        """Mean and variance of what a frame says of its latents: of q(z | s) in a mean field."""
        features = self.body(scaled)
        mean = self.mean(features)
        if self.log_variance is None:
            assert not isinstance(self.settings.variance, str)
            return mean, torch.full_like(mean, self.settings.variance)
        return mean, self.log_variance(features).clamp(*LOG_VARIANCE_RANGE).exp()

    def reconstruction_loss(
        self, latents: Float[Tensor, "n d"], scaled: Float[Tensor, "n *frame"]
    ) -> Float[Tensor, ""]:
        """Negative log-likelihood of frames, nats a frame up to a constant."""
        outputs, settings = self.decoder(latents), self.settings
        if settings.likelihood == "calibrated":
            return calibrated(outputs, scaled, settings.nats, settings.pyramid)
        return UNCALIBRATED[settings.likelihood](outputs, scaled)

    def reconstruct(
        self, scaled: Float[Tensor, "n *frame"], latents: Float[Tensor, "n d"] | None = None
    ) -> Float[Tensor, "n *frame"]:
        """The expected frame for ``latents``, the encoder's mean by default, as scaled frames."""
        if latents is None:
            latents = self.encode(scaled)[0]
        return mean_frame(self.decoder(latents), scaled, self.settings.likelihood)

    def as_frames(self, scaled: Float[Tensor, "n *frame"]) -> Tensor:
        """Scaled frames in stored units."""
        frames = scaled * self.frame_scale + self.frame_mean
        if self.observation.kind == "image":
            return frames.round().clamp(0, 255).to(torch.uint8)
        return frames
