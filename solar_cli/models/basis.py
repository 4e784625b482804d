"""The state that control sees: an affine map of a window of latents, whitened and then fixed.

Blocks of z are [newest latents, differences back through the window]: velocity lives in small
differences, which a basis of plain latents drowns.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from solar_cli.episodes import window_indices

LEAST_SHARE = 1e-4  # of the largest eigenvalue: latents with less variance are noise


def windows_of(latents: Float[Tensor, "N T1 d"], window: int) -> Float[Tensor, "N T1 W d"]:
    """Windows that end at each frame of whole episodes, the newest frame first."""
    index = window_indices(latents.shape[1] - 1, window)
    return latents[:, torch.from_numpy(index[:, ::-1].copy()).to(latents.device)]


class LatentBasis(NamedTuple):
    """z = A w + b for a window w = [y_t, y_{t-1}, ...] of W latents of d entries."""

    A: Float[Tensor, "Wd Wd"]
    b: Float[Tensor, " Wd"]

    @staticmethod
    def whitening(windows: Float[Tensor, "n W d"], hidden: int = 0) -> LatentBasis:
        """Newest latents decorrelated to unit variance, differences scaled to unit std each.

        The ``hidden`` latents, the last ones, are decorrelated apart: they stay the last ones.
        """
        _, window, d = windows.shape
        newest = windows[:, 0]
        centre = newest.mean(dim=0)
        white = torch.zeros(d, d, dtype=windows.dtype, device=windows.device)
        for block in (slice(d - hidden), slice(d - hidden, d))[: 2 if hidden else 1]:
            white[block, block] = _decorrelating((newest - centre)[:, block])
        size = window * d
        A = torch.zeros(size, size, dtype=windows.dtype, device=windows.device)
        A[:d, :d] = white
        for k in range(1, window):
            step = (windows[:, k - 1] - windows[:, k]) @ white.T
            scale = step.std(dim=0)
            rows = white / scale.clamp_min(1e-3 * scale.max().clamp_min(1e-9))[:, None]
            A[k * d : (k + 1) * d, (k - 1) * d : k * d] = rows
            A[k * d : (k + 1) * d, k * d : (k + 1) * d] = -rows
        b = torch.zeros(size, dtype=windows.dtype, device=windows.device)
        b[:d] = -white @ centre
        return LatentBasis(A, b)

    @staticmethod
    def plain(windows: Float[Tensor, "n W d"]) -> LatentBasis:
        """Windows of latents as they are."""
        size = windows.shape[1] * windows.shape[2]
        A = torch.eye(size, dtype=windows.dtype, device=windows.device)
        return LatentBasis(A, torch.zeros_like(A[0]))

    def state(self, windows: Float[Tensor, "*batch W d"]) -> Float[Tensor, "*batch Wd"]:
        """z of windows, newest block first."""
        return windows.flatten(-2) @ self.A.T + self.b

    def successor(self, d: int) -> tuple[Float[Tensor, "Wd Wd"], Float[Tensor, "Wd d"], Tensor]:
        """What shifting does: z_{t+1} = P z_t + G u_{t+1} + h for the newest block u_{t+1}."""
        size = len(self.b)
        eye = torch.eye(size, dtype=self.A.dtype, device=self.A.device)
        shift = torch.zeros_like(self.A)
        shift[d:, : size - d] = eye[: size - d, : size - d]
        white_inverse = torch.linalg.inv(self.A[:d, :d])
        P = self.A @ shift @ torch.linalg.inv(self.A)
        G = self.A[:, :d] @ white_inverse
        return P, G, self.b - P @ self.b - G @ self.b[:d]

    def change_of_variables(self, d: int, actions: int) -> Float[Tensor, "m m"]:
        """The matrix from [y_{t+1}; w_t; a_t; 1] to [u_{t+1} - u_t; z_t; a_t; 1]."""
        size = len(self.b)
        R = torch.zeros(d + size + actions + 1, d + size + actions + 1).to(self.A)
        latents, rest = slice(d, d + size), slice(d + size, None)
        R[:d, :d] = self.A[:d, :d]
        R[:d, latents] = -self.A[:d]
        R[latents, latents] = self.A
        R[latents, -1] = self.b
        R[rest, rest] = torch.eye(actions + 1).to(self.A)
        return R


def _decorrelating(centred: Float[Tensor, "n d"]) -> Float[Tensor, "d d"]:
    """The matrix to unit variance in every direction that varies."""
    d = centred.shape[1]
    values, vectors = torch.linalg.eigh(centred.T.cov().reshape(d, d))
    floor = LEAST_SHARE * values[-1].clamp_min(1e-12)
    matrix: Tensor = vectors.T / values.clamp_min(floor).sqrt()[:, None]
    return matrix
