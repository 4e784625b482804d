"""The loop of trainings that are long: they can stop at a pulse, and go on with the same bits.

What a step draws is to be keyed by its number; `Descent.state_dict` holds the rest.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from solar_cli.pulse import Diverged, Pulse


class Step(NamedTuple):
    """Where a run stands."""

    number: int
    """steps before this one"""
    share: float
    """of all steps, that are done"""
    pausing: bool
    """whether the run can stop after this one"""


class Descent:
    """Runs of gradient steps, one at a time."""

    def __init__(self, what: str, pause: int, pulse: Pulse) -> None:
        """A pulse says that ``what`` goes on, every ``pause`` steps and after the last one."""
        self.what, self.pause, self.pulse = what, pause, pulse
        self._running: dict[str, Any] | None = None
        self._optimiser: torch.optim.Optimizer | None = None
        self._loss: Tensor | None = None

    def steps(
        self,
        name: str,
        optimiser: torch.optim.Optimizer,
        count: int,
        rate: Callable[[float], float],
        **record: Any,
    ) -> Iterator[Step]:
        """Each of ``count`` steps, to be taken by `descend`, with the learning rate of its share.

        A run of that name that was interrupted goes on; one that is over has to be ended by `end`
        before the next begins. ``record`` is what it has to write down at first.
        """
        if self._running is None or self._running["name"] != name:
            self._running = {"name": name, "step": 0, "seconds": 0.0, **record}
        elif "optimiser" in self._running:
            optimiser.load_state_dict(self._running.pop("optimiser"))
        self._optimiser, running, last = optimiser, self._running, time.perf_counter()
        while (done := running["step"]) < count:
            share = done / count
            for group in optimiser.param_groups:
                group["lr"] = rate(share)
            running["step"] += 1
            pausing = running["step"] % self.pause == 0 or running["step"] == count
            yield Step(done, share, pausing)
            if pausing:
                # A number is read now and then only: that waits for the device.
                if self._loss is not None and not math.isfinite(float(self._loss)):
                    raise Diverged(f"{self.place}: the loss is not finite")
                running["seconds"] += time.perf_counter() - last
                self.pulse(f"{self.what} ({name})", running["step"] / count)
                last = time.perf_counter()  # a pulse may take its time to save

    def descend(self, loss: Tensor, clip: float | None = None) -> None:
        """Take a step down ``loss``, with a gradient that is at most ``clip`` long."""
        assert self._optimiser is not None
        self._loss = loss.detach()
        self._optimiser.zero_grad()
        torch.autograd.backward(loss)
        if clip is not None:
            parameters = [one for group in self._optimiser.param_groups for one in group["params"]]
            torch.nn.utils.clip_grad_norm_(parameters, clip, foreach=True)
        self._optimiser.step()

    @property
    def record(self) -> dict[str, Any]:
        """What the run that is under way has written down, its ``step`` and its ``seconds``."""
        assert self._running is not None
        return self._running

    @property
    def place(self) -> str:
        """Of the run that is under way, for messages."""
        return f"step {self.record['step']} of {self.record['name']}"

    def end(self) -> dict[str, Any]:
        """The record of a run that is over."""
        record = self.record
        self._running = self._optimiser = self._loss = None
        return record

    @property
    def under_way(self) -> bool:
        """Whether a run was interrupted that the next one of its name takes up."""
        return self._running is not None

    def state_dict(self) -> dict[str, Any]:
        """A run that is under way: its record and its optimiser."""
        if self._running is None:
            return {}
        state = dict(self._running)
        return (
            state
            if self._optimiser is None
            else state | {"optimiser": self._optimiser.state_dict()}
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a run that was under way; it goes on when one of its name begins."""
        self._running = dict(state) or None
        self._optimiser = self._loss = None
