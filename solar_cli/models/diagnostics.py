"""Latents against the truth: numbers for a judge, which no learner is given."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def latent_metrics(
    latents: NDArray[np.float64], truth: NDArray[np.float64], names: tuple[str, ...]
) -> dict[str, float]:
    """R2 of linear maps both ways between latents (n, d) and true positions (n, k)."""
    found, shaped = linear_r2(latents, truth), linear_r2(truth, latents)
    return {
        **{f"truth_r2_{name}": float(r2) for name, r2 in zip(names, found, strict=True)},
        **{f"latent_r2_{i}": float(r2) for i, r2 in enumerate(shaped)},
    }


def linear_r2(inputs: NDArray[Any], outputs: NDArray[Any]) -> NDArray[np.float64]:
    """Share of each output column's variance that a linear map of the inputs explains.

    1 for a column that does not vary: there is nothing to explain.
    """
    design = np.column_stack([inputs, np.ones(len(inputs))])
    solution = np.linalg.lstsq(design, outputs, rcond=None)[0]
    residual = outputs - design @ solution
    spread = outputs.var(axis=0)
    return np.where(spread > 1e-12, 1 - residual.var(axis=0) / np.maximum(spread, 1e-12), 1.0)
