"""The scene as MuJoCo's XML."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from solar_cli.envs.sawyer import facts
from solar_cli.envs.sawyer.facts import Joint, Link, Shape

STEP = 0.004
"""seconds of a step of the physics"""
CAMERA = "camera"
LOWER = "lower_brick"
"""body and joint of the free brick"""
# Angles are about fixed axes (capital letters). The armature stands for the rotors of the motors.
# Contacts are as stiff as the step allows: a brick sinks into another by tenths of a millimetre.
# Software rendering takes its time for triangles, so round things have few.
SCENE = """
<mujoco model="sawyer">
  <compiler angle="radian" eulerseq="XYZ" autolimits="true"/>
  <option integrator="implicitfast" cone="elliptic" impratio="10"/>
  <visual>
    <headlight ambient="0.5 0.5 0.5" diffuse="0.3 0.3 0.3" specular="0 0 0"/>
    <quality offsamples="4" shadowsize="0" numslices="8" numstacks="4"/>
  </visual>
  <default>
    <joint armature="0.1"/>
    <geom condim="4" solref="0.008 1" solimp="0.95 0.99 0.0005"/>
  </default>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" width="8" height="48"/>
  </asset>
  <worldbody>
    <light directional="true" dir="-0.3 0.4 -1" diffuse="0.4 0.4 0.4" specular="0 0 0"
      castshadow="false"/>
    <camera name="camera"/>
  </worldbody>
  <actuator/>
</mujoco>
"""


def scene() -> str:
    """The arm that holds a brick, another brick that is free, the table and the camera."""
    root = ElementTree.fromstring(SCENE)
    world, servos = _only(root, "worldbody"), _only(root, "actuator")
    _only(root, "option").set("timestep", text(STEP))
    _only(root, "default/geom").set("friction", text(facts.FRICTION, 0.005, 0.0001))
    for name in ("rgb1", "rgb2"):
        _only(root, "asset/texture").set(name, text(*facts.BACKGROUND))
    _place_camera(_only(world, "camera"))
    _shapes(world, [facts.TABLE])
    bodies = {"world": world}
    for link in facts.LINKS:
        bodies[link.name] = _body(bodies[link.parent], link)
        if link.joint is not None:
            _servo(servos, link.name, link.joint)
    _lower_brick(world)
    return ElementTree.tostring(root, encoding="unicode")


def text(*numbers: float) -> str:
    """Numbers as an attribute, to the last bit."""
    return " ".join(repr(float(number)) for number in numbers)


def _only(root: Element, path: str) -> Element:
    found = root.find(path)
    assert found is not None
    return found


def _place_camera(camera: Element) -> None:
    sight = np.subtract(facts.LOOK, facts.EYE)
    right = np.cross(sight, (0.0, 0.0, 1.0))
    camera.set("pos", text(*facts.EYE))
    camera.set("xyaxes", text(*right, *np.cross(right, sight)))
    camera.set("fovy", text(facts.FIELD_OF_VIEW))


def _body(parent: Element, link: Link) -> Element:
    body = SubElement(
        parent, "body", name=link.name, pos=text(*link.at), euler=text(*link.turn), gravcomp="1"
    )
    _inertial(body, link.mass, link.centre, link.inertia)
    if link.joint is not None:
        SubElement(body, "joint", name=link.name, range=text(link.joint.lower, link.joint.upper))
    _shapes(body, link.shapes)
    return body


def _servo(servos: Element, name: str, joint: Joint) -> None:
    kp, kv, cap = joint.stiffness, joint.stiffness * facts.LAG, joint.torque
    SubElement(servos, "position", joint=name, kp=text(kp), kv=text(kv), forcerange=text(-cap, cap))


def _lower_brick(world: Element) -> None:
    body = SubElement(world, "body", name=LOWER)
    SubElement(body, "freejoint", name=LOWER)
    _inertial(body, facts.LOWER_MASS, (0.0, 0.0, 0.0), facts.LOWER_INERTIA)
    _shapes(body, facts.LOWER_BRICK)


def _inertial(body: Element, mass: float, centre: facts.Vector, inertia: facts.Inertia) -> None:
    xx, xy, xz, yy, yz, zz = inertia
    moments = text(xx, yy, zz, xy, xz, yz)
    SubElement(body, "inertial", mass=text(mass), pos=text(*centre), fullinertia=moments)


def _shapes(body: Element, shapes: Iterable[Shape]) -> None:
    for shape in shapes:
        size = shape.size  # MuJoCo's are halves, but for radii
        if shape.kind == "box":
            size = tuple(side / 2 for side in size)
        elif shape.kind == "cylinder":
            size = size[0], size[1] / 2
        touches = str(int(shape.solid))
        SubElement(
            body,
            "geom",
            type=shape.kind,
            size=text(*size),
            pos=text(*shape.at),
            rgba=text(*shape.colour, 1.0),
            contype=touches,
            conaffinity=touches,
            group="0" if shape.visible else "3",  # a renderer leaves group 3 out
        )
