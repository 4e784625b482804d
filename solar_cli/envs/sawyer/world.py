"""What the task needs of a physics engine."""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import NDArray

from solar_cli.envs.sawyer.control import Floats, Pose


class World(Protocol):
    """One scene: the arm that holds a brick, another brick free on a table, and a camera."""

    def reset(self, joints: Floats, lower: Floats) -> None:
        """All at rest: the arm's joint angles (7,), the free brick's x, y and yaw on the table."""

    def joints(self) -> Floats:
        """The arm's joint angles (7,)."""

    def advance(self, targets: Floats) -> None:
        """Simulate one `control.PERIOD` with these targets (7,) of the joints' servos."""

    def held(self) -> Pose:
        """Pose of the brick in the hand."""

    def lower(self) -> Pose:
        """Pose of the free brick."""

    def image(self) -> NDArray[Any]:
        """What the camera sees, (rows, columns, 3) uint8."""
