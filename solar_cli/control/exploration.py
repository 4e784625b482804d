"""How every method begins: the card's exploration noise, whatever is seen."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from solar_cli.settings import TaskSettings

Floats = NDArray[np.float64]


def smooth_noise(
    shape: tuple[int, int, int], smoothing: float, stream: np.random.Generator
) -> Floats:
    """(N, T, a) unit-variance noise, correlated over about ``smoothing`` steps."""
    if smoothing == 0:
        return stream.standard_normal(shape)
    from scipy.ndimage import gaussian_filter1d

    reach = int(4 * smoothing + 0.5)
    count, horizon, size = shape
    white = stream.standard_normal((count, horizon + 2 * reach, size))
    smooth = gaussian_filter1d(white, smoothing, axis=1)[:, reach : reach + horizon]
    impulse = np.zeros(2 * reach + 1)
    impulse[reach] = 1.0
    gain = np.sqrt(np.square(gaussian_filter1d(impulse, smoothing)).sum())
    return np.asarray(smooth / gain)


class Exploration:
    """The first policy of local methods as plain noise: a `Policy` that needs no torch."""

    def __init__(self, task: TaskSettings) -> None:
        self._task = task

    def start(self, episodes: int, stream: np.random.Generator | None) -> Floats:
        """(N, T, a) the actions of whole episodes; none without a stream."""
        shape = (episodes, self._task.horizon, self._task.action.size)
        if stream is None:
            return np.zeros(shape)
        noise = self._task.exploration
        return noise.std * smooth_noise(shape, noise.smoothing, stream)

    def act(self, observations: NDArray[Any], t: int, state: Floats) -> tuple[Floats, Floats, Any]:
        """As `Policy.act`; the means are zero."""
        return state[:, t], np.zeros_like(state[:, t]), state
