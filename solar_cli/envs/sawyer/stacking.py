"""Sawyer Lego stacking from single images: put the brick in the hand onto one on the table.

Appendix D's cost on a simulated arm; the paper's arm is real, and what it does not say of it is
ours. The lower brick stands a little elsewhere in every episode, and may be pushed. The goal of the
cost is its seat at reset and stays there, as the paper's is a position of the end effector (6.3);
one for each episode is ours. A goal that moved with the brick would let the arm drag it across the
table at no cost. Measures are relative to the brick where it is now.
"""

from __future__ import annotations

import numpy as np

from solar_cli.envs.sawyer import facts
from solar_cli.envs.sawyer.control import Floats, Pose, VelocityControl, angles
from solar_cli.envs.sawyer.world import World
from solar_cli.envs.task import Frames

LOWER_PLACE = (0.60, 0.0)
"""x, y of the lower brick, at the middle of the picture"""
LOWER_TURN = 0.03
"""rad by which it may be turned either way"""
START, START_SPREAD = (0.05, -0.04, 0.09), 0.01
"""m from where the brick should be to where it starts, and how far off that may be either way"""
START_YAW, START_YAW_SPREAD = 0.15, 0.05
"""the same in rad about the vertical"""

AXES = np.array([1.0, 2.0, 1.0])
L1_WEIGHT, L2_WEIGHT, ANGLE_WEIGHT = 1.0, 0.1, 0.15
"""App. D"""

STACKED_HEIGHT, STACKED_ASIDE, STACKED_ANGLE = 0.0015, 0.0025, 0.1
"""m up, m aside and rad by which a stacked brick may be off; on top of the studs it is 4.5 mm up"""


class Stacking:
    """The simulation, in either engine; ``periods`` of the controller make a step."""

    truth_names: tuple[str, ...] = ("x", "y", "z", "yaw", "lower_x", "lower_y")

    def __init__(self, world: World, jitter: float, periods: int, action_cost: float) -> None:
        self.jitter = jitter
        self.periods = periods
        self.action_cost = action_cost
        self._world = world

    def reset(self, stream: np.random.Generator) -> Frames:
        """The lower brick near its place, the arm at rest with the other above and aside."""
        place = LOWER_PLACE + stream.uniform(-self.jitter, self.jitter, 2)
        turn = stream.uniform(-LOWER_TURN, LOWER_TURN)
        offset = START + stream.uniform(-START_SPREAD, START_SPREAD, 3)
        yaw = START_YAW + stream.uniform(-START_YAW_SPREAD, START_YAW_SPREAD)
        start = angles(np.array([*LOWER_PLACE, 1.5 * facts.HEIGHT]) + offset, yaw)
        self._world.reset(start, np.array([*place, turn]))
        self._control = VelocityControl(start)
        lower = self._world.lower()
        self._goal = Pose(seat(lower), lower.rotation)
        return self._frame()

    def step(self, action: Floats) -> tuple[Frames, float]:
        """As `Simulation.step`."""
        cost = self._cost(action)
        for _ in range(self.periods):
            self._world.advance(self._control.targets(action, self._world.joints()))
        return self._frame(), cost

    def ended(self) -> bool:
        """As `Simulation.ended`: never early."""
        return False

    def measures(self) -> dict[str, float]:
        """``distance`` of the brick from its seat, as that is now, in cm; ``stacked``: 1 or 0."""
        held, lower = self._world.held(), self._world.lower()
        off = lower.rotation.T @ (held.position - seat(lower))
        stacked = (
            abs(off[2]) < STACKED_HEIGHT
            and np.hypot(off[0], off[1]) < STACKED_ASIDE
            and angle_between(held, lower) < STACKED_ANGLE
        )
        return {"distance": 100.0 * float(np.linalg.norm(off)), "stacked": float(stacked)}

    def truth(self) -> Floats:
        """Of the held brick in m and rad, and of the lower one, over which the goal is at reset."""
        held, lower = self._world.held(), self._world.lower()
        yaw = np.arctan2(held.rotation[1, 0], held.rotation[0, 0])
        return np.array([*held.position, yaw, *lower.position[:2]])

    def _cost(self, action: Floats) -> float:
        """|W (e - g)|_1 + 0.1 |e - g|_2 + 0.15 |angle to a valid orientation|.

        e is the held brick's position, g the goal.
        """
        held = self._world.held()
        off = held.position - self._goal.position
        place = L1_WEIGHT * np.abs(AXES * off).sum() + L2_WEIGHT * np.linalg.norm(off)
        turned = ANGLE_WEIGHT * angle_between(held, self._goal)
        return float(place + turned + self.action_cost * (action @ action))

    def _frame(self) -> Frames:
        return np.ascontiguousarray(self._world.image().transpose(2, 0, 1))


def seat(lower: Pose) -> Floats:
    """Where a brick is that sits on this one: (3,)."""
    return lower.position + facts.HEIGHT * lower.rotation[:, 2]


def angle_between(one: Pose, other: Pose) -> float:
    """rad of the smallest turn that makes the orientations fit; half turns about the studs do."""
    x, y, z = np.diagonal(other.rotation.T @ one.rotation)
    return float(np.arccos(np.clip((abs(x + y) + z - 1.0) / 2.0, -1.0, 1.0)))
