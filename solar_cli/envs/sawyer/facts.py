"""The Sawyer arm, the bricks and the camera: one table, from which both engines' models are made.

Lengths in m, angles in rad, masses in kg, torques in Nm. A frame's ``turn`` is roll, pitch, yaw
about fixed axes, as in a URDF. The arm's frames, limits, masses and primitives are those of
sawyer_description (RethinkRobotics/sawyer_robot, ``sawyer_base.urdf.xacro`` at commit 2fe61d9,
Apache-2.0), its head turned straight and frozen. Gripper, bricks, table, camera, servos and colours
are ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Vector = tuple[float, float, float]
Inertia = tuple[float, float, float, float, float, float]
"""xx, xy, xz, yy, yz, zz about the centre of mass, along the link's axes"""

HALF_PI = 1.57079632679
RED, GREY, DARK = (0.55, 0.08, 0.10), (0.62, 0.63, 0.65), (0.15, 0.15, 0.17)
YELLOW, BLUE, WOOD = (0.98, 0.80, 0.05), (0.10, 0.30, 0.85), (0.86, 0.83, 0.78)
BACKGROUND = (0.93, 0.94, 0.96)


@dataclass(frozen=True)
class Shape:
    """A primitive, its axes along those of its link."""

    kind: Literal["box", "cylinder", "sphere"]
    size: tuple[float, ...]
    """whole sides of a box; radius and length of a cylinder along z; radius of a sphere"""
    at: Vector
    colour: Vector
    solid: bool = False
    """whether it touches others; the arm never comes near anything, only what it holds does"""
    visible: bool = True


@dataclass(frozen=True)
class Joint:
    """A hinge about the z axis of its link, moved by a position servo."""

    lower: float
    upper: float
    speed: float
    """rad/s that it may turn at"""
    torque: float
    """cap of the servo. The motors' own 80 to 9 Nm would crush the bricks."""
    stiffness: float
    """of the servo, Nm/rad"""


@dataclass(frozen=True)
class Link:
    """A rigid body in the frame of its parent."""

    name: str
    parent: str
    at: Vector
    turn: Vector
    mass: float
    centre: Vector
    inertia: Inertia
    joint: Joint | None = None
    shapes: tuple[Shape, ...] = ()


# Duplo bricks of 2 x 4 studs, which a camera of 84 pixels can see. A brick's frame is at the middle
# of its block, its studs up.
PITCH, STUD_RADIUS, STUD_HEIGHT = 0.016, 0.0047, 0.0045
LENGTH, WIDTH, HEIGHT = BLOCK = (0.0636, 0.0318, 0.0192)
PLUG = (3 * PITCH + 2 * STUD_RADIUS, PITCH + 2 * STUD_RADIUS, STUD_HEIGHT)
"""envelope of the studs, which is what a hollow brick without tubes feels of them"""
CLEARANCE = 0.002
"""gap on every side between studs and wall; a pixel is 4 mm"""
ROOF = 0.005
HELD_MASS, LOWER_MASS = 0.03, 0.2
"""the lower brick is weighted: PyBullet lets a light one between arm and table be crushed"""


def block_inertia(mass: float, sides: Vector) -> Inertia:
    """Of a solid block."""
    (x, y, z), share = sides, mass / 12.0
    return share * (y * y + z * z), 0.0, 0.0, share * (x * x + z * z), 0.0, share * (x * x + y * y)


LOWER_INERTIA = block_inertia(LOWER_MASS, BLOCK)


def _studs(colour: Vector) -> tuple[Shape, ...]:
    top, size = (HEIGHT + STUD_HEIGHT) / 2.0, (STUD_RADIUS, STUD_HEIGHT)
    places = [(PITCH * (i - 1.5), PITCH * (j - 0.5), top) for i in range(4) for j in range(2)]
    return tuple(Shape("cylinder", size, place, colour) for place in places)


def _shell(colour: Vector) -> tuple[Shape, ...]:
    """A roof and four walls."""
    x, y = (LENGTH - PLUG[0]) / 2 - CLEARANCE, (WIDTH - PLUG[1]) / 2 - CLEARANCE
    boxes = [((LENGTH, WIDTH, ROOF), (0.0, 0.0, (HEIGHT - ROOF) / 2))]
    boxes += [((x, WIDTH, HEIGHT), (side * (LENGTH - x) / 2, 0.0, 0.0)) for side in (-1, 1)]
    boxes += [((LENGTH, y, HEIGHT), (0.0, side * (WIDTH - y) / 2, 0.0)) for side in (-1, 1)]
    return tuple(Shape("box", size, at, colour, solid=True) for size, at in boxes)


def _gripper() -> tuple[Shape, ...]:
    """A palm, and two fingers that reach down to the middle of the brick's long sides."""
    fingers = [
        Shape(
            "box", (0.008, 0.016, 0.092), (side * (WIDTH / 2 + 0.004), 0.0, 0.101), DARK, solid=True
        )
        for side in (-1, 1)
    ]
    return (
        Shape("cylinder", (0.035, 0.03), (0.0, 0.0, 0.02), GREY),
        Shape("box", (0.09, 0.05, 0.03), (0.0, 0.0, 0.045), DARK),
        *fingers,
    )


LAG = 0.025
"""s by which a servo is behind a target that moves evenly"""
HELD, HAND = "held_brick", "right_hand"
LINKS = (
    Link(
        "right_arm_base_link", "world", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0),
        2.0687, (-0.0006241, -2.8025e-05, 0.065404),
        (0.0067599, -4.2024e-05, -6.1904e-07, 0.0067877, 1.5888e-05, 0.0074031),
        shapes=(Shape("cylinder", (0.08, 0.24), (0.0, 0.0, 0.12), DARK),),
    ),
    Link(
        "right_l0", "right_arm_base_link", (0.0, 0.0, 0.08), (0.0, 0.0, 0.0),
        5.3213, (0.024366, 0.010969, 0.14363),
        (0.053314, 0.0047093, 0.011734, 0.057902, 0.0080179, 0.023659),
        Joint(-3.0503, 3.0503, 1.74, 12.0, 4000.0),
        (Shape("sphere", (0.07,), (0.08, 0.0, 0.23), RED),),
    ),
    Link(
        "head", "right_l0", (0.0, 0.0, 0.2965), (0.0, 0.0, 0.0),
        1.5795, (0.0053207, -2.6549e-05, 0.1021),
        (0.011833, -4.4669e-06, 4.9425e-05, 0.0082709, 4.2124e-07, 0.0049661),
        shapes=(Shape("box", (0.002, 0.24, 0.14), (0.03, 0.0, 0.105), DARK),),
    ),
    Link(
        "right_l1", "right_l0", (0.081, 0.05, 0.237), (-HALF_PI, HALF_PI, 0.0),
        4.505, (-0.0030849, -0.026811, 0.092521),
        (0.022398, -0.00023986, -0.00029362, 0.014613, -0.0060875, 0.017295),
        Joint(-3.8095, 2.2736, 1.328, 12.0, 3000.0),
        (
            Shape("sphere", (0.07,), (0.0, 0.0, 0.1225), RED),
            Shape("cylinder", (0.07, 0.14), (0.0, 0.0, 0.035), RED),
        ),
    ),
    Link(
        "right_l2", "right_l1", (0.0, -0.14, 0.1425), (HALF_PI, 0.0, 0.0),
        1.745, (-0.00016044, -0.014967, 0.13582),
        (0.025506, 4.4101e-06, 1.4955e-05, 0.0253, -0.0033204, 0.0034179),
        Joint(-3.0426, 3.0426, 1.957, 8.0, 1500.0),
        (
            Shape("cylinder", (0.06, 0.34), (0.0, 0.0, 0.08), RED),
            Shape("sphere", (0.06,), (0.0, 0.0, 0.26), RED),
        ),
    ),
    Link(
        "right_l3", "right_l2", (0.0, -0.042, 0.26), (-HALF_PI, 0.0, 0.0),
        2.5097, (-0.0048135, -0.0281, -0.084154),
        (0.01016, -9.7452e-06, 0.00026624, 0.0065685, 0.0030316, 0.0069078),
        Joint(-3.0439, 3.0439, 1.957, 8.0, 1500.0),
        (Shape("sphere", (0.06,), (0.0, -0.01, -0.12), RED),),
    ),
    Link(
        "right_l4", "right_l3", (0.0, -0.125, -0.1265), (HALF_PI, 0.0, 0.0),
        1.1136, (-0.0018844, 0.0069001, 0.1341),
        (0.013557, 1.8109e-05, 0.00013523, 0.013555, 0.0010561, 0.0013658),
        Joint(-2.9761, 2.9761, 3.485, 3.0, 500.0),
        (
            Shape("cylinder", (0.045, 0.30), (0.0, 0.0, 0.11), RED),
            Shape("sphere", (0.06,), (0.0, 0.01, 0.26), RED),
        ),
    ),
    Link(
        "right_l5", "right_l4", (0.0, 0.031, 0.275), (-HALF_PI, 0.0, 0.0),
        1.5625, (0.0061133, -0.023697, 0.076416),
        (0.0047328, 0.00011526, 4.6269e-05, 0.0029676, -0.0011557, 0.0031762),
        Joint(-2.9761, 2.9761, 3.485, 3.0, 500.0),
        (Shape("sphere", (0.06,), (0.0, 0.0, 0.1), RED),),
    ),
    Link(
        "right_l6", "right_l5", (0.0, -0.11, 0.1053), (-HALF_PI, -0.17453, 3.1416),
        0.3292, (-8.0726e-06, 0.0085838, -0.0049566),
        (0.00031105, 1.4771e-06, -3.7074e-07, 0.00021549, -8.4533e-06, 0.00035976),
        Joint(-4.7124, 4.7124, 4.545, 2.0, 200.0),
        (Shape("cylinder", (0.055, 0.05), (0.0, 0.015, -0.01), DARK),),
    ),
    Link(
        HAND, "right_l6", (0.0, 0.0, 0.0245), (0.0, 0.0, 1.570796),
        0.5, (0.0, 0.0, 0.06), block_inertia(0.5, (0.09, 0.05, 0.12)),
        shapes=_gripper(),
    ),
    Link(
        HELD, HAND, (0.0, 0.0, 0.145), (2 * HALF_PI, 0.0, HALF_PI),
        HELD_MASS, (0.0, 0.0, 0.0), block_inertia(HELD_MASS, BLOCK),
        shapes=(*_shell(YELLOW), *_studs(YELLOW)),
    ),
)  # fmt: skip
"""the arm with what it holds, parents first"""

LOWER_BRICK = (
    Shape("box", BLOCK, (0.0, 0.0, 0.0), BLUE, solid=True),
    Shape("box", PLUG, (0.0, 0.0, (HEIGHT + STUD_HEIGHT) / 2), BLUE, solid=True, visible=False),
    *_studs(BLUE),
)
"""the brick that stands free on the table"""
TABLE = Shape("box", (3.0, 3.0, 0.04), (0.5, 0.0, -0.02), WOOD, solid=True)
"""its top is at z = 0, which the arm's base stands on too"""

HOME = (-0.2973, -1.0287, 0.0542, 1.7223, -0.0363, 0.8781, 3.0884)
"""joint angles near all those of an episode: the hand points down, over the table's middle"""
EYE, LOOK, FIELD_OF_VIEW = (1.02, -0.34, 0.30), (0.60, 0.0, 0.085), 34.0
"""the camera: its place, what it looks at, and its vertical angle in degrees"""
FRICTION = 0.5
"""of everything on everything: plastic"""
