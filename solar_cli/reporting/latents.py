"""A latent space against the truth, in the manner of Figure 6: what a judge sees of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from solar_cli.models.diagnostics import linear_r2
from solar_cli.reporting import figures

COLUMNS = 2
"""Panels side by side."""
WIDTH, HEIGHT = 2.3, 2.1
"""Of a panel, in inches."""

Floats = NDArray[np.float64]


def latent_space(latents: NDArray[Any], truth: NDArray[Any], names: Sequence[str]) -> Figure | None:
    """Latents (n, d) along their first two principal components, a panel a true coordinate.

    Colour is the coordinate, of ``truth`` (n, k); the title says its R2, how well a linear map of
    all d latents tells it, and the axes their shares of the variance. None where no coordinate
    varies.
    """
    moving = [place for place in range(len(names)) if np.ptp(truth[:, place]) > 0]
    if not moving:
        return None
    points, shares = principal_components(latents)
    found = linear_r2(latents.astype(np.float64), truth.astype(np.float64))
    columns, rows = min(COLUMNS, len(moving)), -(-len(moving) // COLUMNS)
    with mpl.rc_context({**figures.STYLE, "font.size": 8, "axes.titlesize": 9}):
        figure = Figure(figsize=(WIDTH * columns, HEIGHT * rows), layout="constrained")
        for panel, place in enumerate(moving):
            axes = figure.add_subplot(rows, columns, panel + 1)
            shown = axes.scatter(
                points[:, 0], points[:, 1], c=truth[:, place], s=3, linewidths=0, cmap="viridis"
            )
            figure.colorbar(shown, ax=axes)
            axes.set_title(f"{names[place]}, R² {found[place]:.2f}")
            axes.set(xticks=[], yticks=[])
        figure.supxlabel(f"first principal component ({shares[0]:.0%})", fontsize=8)
        figure.supylabel(f"second principal component ({shares[1]:.0%})", fontsize=8)
    return figure


def principal_components(latents: NDArray[Any]) -> tuple[Floats, Floats]:
    """The first two of latents (n, d): points (n, 2), and each one's share of all variance.

    A component's sign is that which makes its largest weight positive; of one latent the second
    component is zero.
    """
    centred = latents.astype(np.float64) - latents.mean(axis=0, dtype=np.float64)
    _, lengths, axes = np.linalg.svd(centred, full_matrices=False)
    largest = np.abs(axes).argmax(axis=1)
    axes = axes * np.sign(axes[np.arange(len(axes)), largest])[:, None]
    shares = np.square(lengths) / max(np.square(lengths).sum(), np.finfo(float).tiny)
    missing = max(0, 2 - len(axes))
    points = np.pad(centred @ axes[:2].T, ((0, 0), (0, missing)))
    return points, np.pad(shares[:2], (0, missing))
