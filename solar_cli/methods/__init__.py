"""One file a method; what the worker asks of each is `Learner`.

No method is imported here: `solar_cli.settings.registry` finds its module when it is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from solar_cli.pulse import Diverged, Pulse

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from solar_cli.episodes import Episodes, Evaluation, Policy
    from solar_cli.experience import Experience

__all__ = ["Diverged", "Foreseeing", "Learner", "Pulse"]


class Learner(Protocol):
    """A method at work on one cell.

    It is constructed as ``Learner(settings, task, streams, device, pulse)``: its own settings, the
    `TaskSettings`, `Streams` to draw from, a torch device's name, and a `Pulse`. A method without
    latents or a model of frames inherits from it, and leaves the last three as they are.
    """

    @property
    def policy(self) -> Policy:
        """The policy that it would hand over now."""

    def iterate(self, experience: Experience) -> dict[str, float]:
        """One iteration: collect, learn; the metrics of what happened. Raises `Diverged`.

        Restored from a state that was saved inside an iteration, at a pulse or while it collects,
        the next call does that iteration again, with the same bits: what it collected is on disk,
        and long training goes on where it stood.
        """

    def state_dict(self) -> dict[str, Any]:
        """Everything the next step depends on but the episodes: plain data and tensors."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a saved state."""

    def diagnose(self, evaluation: Evaluation) -> dict[str, float]:
        """Metrics of the representation against the truth: for a judge, never learned from."""
        return {}

    def encode(self, episodes: Episodes) -> NDArray[Any] | None:
        """(N, T+1, d) the newest latents at every frame; None for a method without."""
        return None

    def reconstruct(self, episodes: Episodes) -> NDArray[Any] | None:
        """Frames as the model sees them, like ``episodes.frames``; None for a method without."""
        return None


@runtime_checkable
class Foreseeing(Protocol):
    """What a learner may have besides, whose model predicts frames."""

    def foresee(self, episodes: Episodes) -> NDArray[Any] | None:
        """Frames (N, H, *frame) 1 to H steps after the first of each episode, as in its frames.

        Predicted from that one and the actions; None before there is a model.
        """
