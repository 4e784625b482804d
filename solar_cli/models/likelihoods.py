"""Observation models p(s | z): how far a decoded frame is from the frame (Eq. 4, appendix D).

Every function takes the decoder's outputs and the target frames, (n, *frame), and returns the
negative log-likelihood a frame, in nats, up to a constant.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

PYRAMID = ((4, 16.0), (8, 64.0))
"""Side and weight of the pooled residuals: they make small things that are misplaced count."""


def pyramid_error(residual: Float[Tensor, "n *frame"]) -> Float[Tensor, ""]:
    """Mean squared residual, with that of its pooled versions for images that are large enough."""
    error = residual.square().mean()
    if residual.ndim == 4:
        for side, weight in PYRAMID:
            if min(residual.shape[-2:]) >= side:
                error = error + weight * functional.avg_pool2d(residual, side).square().mean()
    return error


def calibrated(
    outputs: Float[Tensor, "n *frame"],
    frames: Float[Tensor, "n *frame"],
    nats: float,
    pyramid: bool,
) -> Float[Tensor, ""]:
    """A Gaussian whose common scale is the best one: D/2 log of the error (sigma-VAE).

    Rybkin et al. 2021 derive it for plain pixels; the effective D/2, ``nats``, is ours.
    """
    residual = outputs - frames
    error = pyramid_error(residual) if pyramid else residual.square().mean()
    return nats * error.log()


def gaussian(outputs: Float[Tensor, "n *frame"], frames: Float[Tensor, "n *frame"]) -> Tensor:
    """A Gaussian of unit variance."""
    return 0.5 * (outputs - frames).square().flatten(1).sum(dim=1).mean()


def bernoulli(outputs: Float[Tensor, "n *frame"], frames: Float[Tensor, "n *frame"]) -> Tensor:
    """Independent Bernoulli pixels; outputs are logits, frames lie in [0, 1]."""
    loss = functional.binary_cross_entropy_with_logits(outputs, frames, reduction="none")
    return loss.flatten(1).sum(dim=1).mean()


def categorical(
    outputs: Float[Tensor, "n c h w"], frames: Float[Tensor, "n c h w"]
) -> Float[Tensor, ""]:
    """One categorical over the pixels of each channel; a frame's channel is a distribution."""
    target = frames.flatten(2)
    target = target / target.sum(dim=-1, keepdim=True).clamp_min(1e-6)
    return -(target * outputs.flatten(2).log_softmax(dim=-1)).sum(dim=(1, 2)).mean()


def mean_frame(outputs: Tensor, frames: Tensor, likelihood: str) -> Tensor:
    """The expected frame under p(s | z), in the units of ``frames``."""
    if likelihood == "bernoulli":
        return outputs.sigmoid()
    if likelihood == "categorical":
        share = outputs.flatten(2).softmax(dim=-1).view_as(outputs)
        return share * frames.sum(dim=(2, 3), keepdim=True)
    return outputs


UNCALIBRATED: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "gaussian": gaussian,
    "bernoulli": bernoulli,
    "categorical": categorical,
}


def explained_variance(
    expected: Float[Tensor, "n *frame"], frames: Float[Tensor, "n *frame"]
) -> Float[Tensor, " c"]:
    """Share of each channel's (each entry's) variance over frames that the model explains."""
    axes = (0, *range(2, frames.ndim))
    residual = (expected - frames).square().mean(dim=axes)
    spread = (frames - frames.mean(dim=0)).square().mean(dim=axes)
    # A channel that never changes holds nothing to explain.
    return torch.where(spread > 1e-12, 1 - residual / spread.clamp_min(1e-12), 1.0)
