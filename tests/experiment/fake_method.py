"""A tiny deterministic learner that comes through the entry point, and fails when it is told to."""

import os
import signal
import time
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from solar_cli.episodes import Episodes, Evaluation
from solar_cli.experience import Experience
from solar_cli.methods import Diverged, Pulse
from solar_cli.settings import MethodEntry, TaskSettings
from solar_cli.settings.local import Budget
from solar_cli.settings.schema import Settings, setting
from solar_cli.streams import Streams

ENTRY = MethodEntry(
    name="fake",
    summary="A random walk of linear gains.",
    source="tests",
    settings="fake_method:FakeSettings",
    learner="fake_method:Fake",
)


class FakeSettings(Settings):
    budget: Budget = setting(Budget(desk=12, full=16), "where to stop", presentation=True)
    batch: int = setting(4, "episodes an iteration")
    steps: int = setting(3, "pulses an iteration")
    hold: str = setting("", "a file that keeps an iteration from going on")
    trouble: Literal["none", "raise", "diverge", "nan", "factorise", "segfault"] = setting(
        "none", "what goes wrong"
    )
    at: int = setting(2, "iteration in which it goes wrong, or holds")


def features(observations: NDArray[Any]) -> NDArray[np.float64]:
    """(N, 3): the newest frame seen through three fixed waves."""
    pixels = observations[:, -1].reshape(len(observations), -1) / 255.0
    waves = np.cos(np.outer(np.arange(pixels.shape[1]), [0.01, 0.1, 1.0]))
    projected: NDArray[np.float64] = pixels @ waves / 100.0
    return projected


class FakePolicy:
    def __init__(self, weights: torch.Tensor, std: float) -> None:
        self.weights, self.std = weights.numpy().copy(), std

    def start(self, episodes: int, stream: np.random.Generator | None) -> Any:
        return stream

    def act(self, observations: NDArray[Any], t: int, state: Any) -> Any:
        means = features(observations) @ self.weights
        noise = 0.0 if state is None else self.std * state.standard_normal(means.shape)
        return means + noise, means, state


class Fake:
    def __init__(
        self,
        settings: FakeSettings,
        task: TaskSettings,
        streams: Streams,
        device: str,
        pulse: Pulse,
    ) -> None:
        self.settings, self.task, self.streams, self.pulse = settings, task, streams, pulse
        self.weights = torch.zeros(3, task.action.size, dtype=torch.float64)
        self.momentum = torch.zeros_like(self.weights)
        self.step = 0

    @property
    def policy(self) -> FakePolicy:
        return FakePolicy(self.weights, self.task.exploration.std)

    def iterate(self, experience: Experience) -> dict[str, float]:
        experience.collect(self.policy, self.settings.batch)
        cost = float(Episodes.joined(experience.recent(2)).costs.mean())
        while self.step < self.settings.steps:
            self._fail(experience.iteration)
            stream = self.streams.generator(experience.iteration, self.step)
            push = torch.from_numpy(stream.standard_normal(self.weights.shape))
            self.momentum = 0.9 * self.momentum + cost * push
            self.weights = self.weights + 0.01 * self.momentum
            self.step += 1
            self.pulse("walking", self.step / self.settings.steps)
            self._hold(experience.iteration)
        self.step = 0
        return {"norm": float(self.weights.norm()), "seconds_walking": time.perf_counter()}

    def _hold(self, iteration: int) -> None:
        held = self.settings.hold and iteration == self.settings.at
        while held and os.path.exists(self.settings.hold):
            time.sleep(0.02)
            self.pulse("held", self.step / self.settings.steps)

    def _fail(self, iteration: int) -> None:
        if iteration != self.settings.at or self.step < 1:
            return
        match self.settings.trouble:
            case "raise":
                raise ZeroDivisionError("told to raise")
            case "diverge":
                raise Diverged("told to diverge")
            case "nan":
                self.weights = self.weights * torch.nan
            case "factorise":
                torch.linalg.cholesky(self.weights.T @ self.weights * torch.nan)
            case "segfault":
                os.kill(os.getpid(), signal.SIGSEGV)

    def state_dict(self) -> dict[str, Any]:
        return {"weights": self.weights, "momentum": self.momentum, "step": self.step}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.weights, self.momentum = state["weights"], state["momentum"]
        self.step = state["step"]

    def diagnose(self, evaluation: Evaluation) -> dict[str, float]:
        return {"frames": float(evaluation.episodes.frames.mean())}

    def encode(self, episodes: Episodes) -> NDArray[Any] | None:
        count, times, *frame = episodes.frames.shape
        return features(episodes.frames.reshape(-1, 1, *frame)).reshape(count, times, 3)

    def reconstruct(self, episodes: Episodes) -> NDArray[Any] | None:
        return episodes.frames
