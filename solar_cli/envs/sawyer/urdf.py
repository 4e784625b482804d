"""The arm, the free brick and the table as URDF, each a file of its own."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from solar_cli.envs.sawyer import facts
from solar_cli.envs.sawyer.facts import Inertia, Link, Shape, Vector
from solar_cli.envs.sawyer.mjcf import text

MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
NOWHERE, MASSLESS = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def arm() -> str:
    """The arm with what it holds."""
    root = Element("robot", name="sawyer")
    for link in facts.LINKS:
        _link(root, link.name, link.mass, link.centre, link.inertia, link.shapes)
    for link in facts.LINKS:
        if link.parent != "world":
            _joint(root, link)
    return _written(root)


def lower_brick() -> str:
    """The free brick."""
    root = Element("robot", name="lower_brick")
    _link(root, "brick", facts.LOWER_MASS, NOWHERE, facts.LOWER_INERTIA, facts.LOWER_BRICK)
    return _written(root)


def table() -> str:
    """The table, which has no mass because it never moves."""
    root = Element("robot", name="table")
    _link(root, "table", 0.0, NOWHERE, MASSLESS, [facts.TABLE])
    return _written(root)


def _written(root: Element) -> str:
    ElementTree.indent(root)  # PyBullet cannot read one long line
    return ElementTree.tostring(root, encoding="unicode")


def _link(
    root: Element, name: str, mass: float, centre: Vector, inertia: Inertia, shapes: Iterable[Shape]
) -> None:
    link = SubElement(root, "link", name=name)
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=text(*centre))
    SubElement(inertial, "mass", value=text(mass))
    SubElement(inertial, "inertia", dict(zip(MOMENTS, map(text, inertia), strict=True)))
    for shape in shapes:
        if shape.visible:
            visual = _shape(link, "visual", shape)
            # Materials are known by name, so each colour needs one of its own.
            material = SubElement(visual, "material", name=text(*shape.colour))
            SubElement(material, "color", rgba=text(*shape.colour, 1.0))
        if shape.solid:
            _shape(link, "collision", shape)


def _shape(link: Element, use: str, shape: Shape) -> Element:
    element = SubElement(link, use)
    SubElement(element, "origin", xyz=text(*shape.at))
    geometry = SubElement(element, "geometry")
    if shape.kind == "box":
        SubElement(geometry, "box", size=text(*shape.size))
    elif shape.kind == "cylinder":
        radius, length = shape.size
        SubElement(geometry, "cylinder", radius=text(radius), length=text(length))
    else:
        SubElement(geometry, "sphere", radius=text(*shape.size))
    return element


def _joint(root: Element, link: Link) -> None:
    hinge = link.joint
    kind = "fixed" if hinge is None else "revolute"
    joint = SubElement(root, "joint", name=f"to_{link.name}", type=kind)
    SubElement(joint, "parent", link=link.parent)
    SubElement(joint, "child", link=link.name)
    SubElement(joint, "origin", xyz=text(*link.at), rpy=text(*link.turn))
    if hinge is not None:
        SubElement(joint, "axis", xyz="0 0 1")
        limits = {"lower": hinge.lower, "upper": hinge.upper}
        limits |= {"effort": hinge.torque, "velocity": hinge.speed}
        SubElement(joint, "limit", {name: text(value) for name, value in limits.items()})
