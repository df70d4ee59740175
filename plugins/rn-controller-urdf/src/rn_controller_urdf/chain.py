"""The serial chain between two links of a URDF: kinematics only, without meshes, masses and side
branches.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass

from roboneuron import ConfigurationError, JointKinds

_MOVING = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, kw_only=True, slots=True)
class ChainJoint:
    """One joint of the chain, as the URDF describes it.

    Attributes:
        name: joint name.
        type: "fixed", "revolute", "continuous" or "prismatic".
        parent, child: link names.
        origin_xyz, origin_rpy: texts of the joint's origin [m], [rad].
        axis: text of the joint axis in the joint frame.
        lower, upper: position limits [rad or m]; infinite where the URDF gives none.
        velocity: velocity limit [rad/s or m/s]; infinite where the URDF gives none.
        is_follower: it mimics another joint; `RobotProfile.kinds` has which.
    """

    name: str
    type: str
    parent: str
    child: str
    origin_xyz: str
    origin_rpy: str
    axis: str
    lower: float
    upper: float
    velocity: float
    is_follower: bool

    @property
    def is_moving(self) -> bool:
        """False for fixed joints."""
        return self.type != "fixed"

    @property
    def is_prismatic(self) -> bool:
        """True when positions are metres."""
        return self.type == "prismatic"


def _vector(element: ET.Element | None, attribute: str, default: str, joint: str) -> str:
    text = default if element is None else element.get(attribute, default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != 3 or not all(math.isfinite(v) for v in values):
        raise ConfigurationError(
            f"URDF joint {joint!r}: {attribute} is {text!r}, expected three finite numbers."
        )
    return text


def _link(element: ET.Element, role: str, joint: str) -> str:
    node = element.find(role)
    link = None if node is None else node.get("link")
    if not link:
        raise ConfigurationError(
            f'URDF joint {joint!r} has no {role} link, expected <{role} link="..."/>.'
        )
    return link


def _parse_joint(element: ET.Element, kinds: JointKinds) -> ChainJoint:
    name, kind = element.get("name", ""), element.get("type", "")
    origin = element.find("origin")
    lower, upper = kinds.limits(name)
    axis = _vector(element.find("axis"), "xyz", "1 0 0", name)
    if kind != "fixed" and not any(float(word) for word in axis.split()):
        raise ConfigurationError(f"URDF joint {name!r}: its axis is zero, expected a direction.")
    return ChainJoint(
        name=name,
        type=kind,
        parent=_link(element, "parent", name),
        child=_link(element, "child", name),
        origin_xyz=_vector(origin, "xyz", "0 0 0", name),
        origin_rpy=_vector(origin, "rpy", "0 0 0", name),
        axis=axis,
        lower=lower,
        upper=upper,
        velocity=kinds.velocity_limit(name),
        is_follower=element.find("mimic") is not None,
    )


def parse_chain(urdf: str, base_link: str, tcp_link: str) -> tuple[ChainJoint, ...]:
    """Return the joints from `base_link` to `tcp_link`, base to tip, fixed ones included.

    Raises:
        ConfigurationError: not a URDF, a link is missing, `base_link` is not above `tcp_link`, or a
            joint in between has a type that this controller cannot move (floating, planar).
    """
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError as error:
        raise ConfigurationError(
            f"The robot description is not XML: {error}.", hint="Expand xacro files to URDF first."
        ) from error
    if root.tag != "robot":
        raise ConfigurationError(
            f"The robot description is a <{root.tag}>, expected a URDF <robot>."
        )
    links = {link.get("name", "") for link in root.findall("link")}
    for role, link in (("base_link", base_link), ("tcp_link", tcp_link)):
        if link not in links:
            raise ConfigurationError(
                f"The robot description has no link {link!r} ({role} of the profile).",
                hint=f"Its links are: {', '.join(sorted(links))}.",
            )
    above = {
        _link(element, "child", element.get("name", "")): element
        for element in root.findall("joint")
    }
    chain: list[ChainJoint] = []
    kinds = JointKinds.of(urdf)
    link = tcp_link
    while link != base_link:
        if link not in above or len(chain) > len(above):
            raise ConfigurationError(
                f"The link {tcp_link!r} does not hang from {base_link!r} in the robot description; "
                f"its chain ends at {link!r}."
            )
        joint = _parse_joint(above[link], kinds)
        if joint.is_moving and joint.type not in _MOVING:
            raise ConfigurationError(
                f"URDF joint {joint.name!r} is of type {joint.type!r}, expected fixed or one of "
                f"{', '.join(_MOVING)}."
            )
        chain.append(joint)
        link = joint.parent
    return tuple(reversed(chain))


def kinematic_urdf(chain: tuple[ChainJoint, ...]) -> str:
    """Return a URDF with only `chain`, rooted at its first link."""
    robot = ET.Element("robot", name="chain")
    for link in (chain[0].parent, *(joint.child for joint in chain)):
        ET.SubElement(robot, "link", name=link)
    for joint in chain:
        element = ET.SubElement(robot, "joint", name=joint.name, type=joint.type)
        ET.SubElement(element, "parent", link=joint.parent)
        ET.SubElement(element, "child", link=joint.child)
        ET.SubElement(element, "origin", xyz=joint.origin_xyz, rpy=joint.origin_rpy)
        if joint.is_moving:
            ET.SubElement(element, "axis", xyz=joint.axis)
    return one_coordinate(robot)


def one_coordinate(robot: ET.Element) -> str:
    """Return a URDF for pinocchio in which each moving joint has one coordinate, its position.

    A continuous joint has two otherwise, cosine and sine. Limits are not pinocchio's business: its
    parser refuses a revolute joint without them. Followers are set as others are. Modifies `robot`.
    """
    for joint in robot.findall("joint"):
        if joint.get("type") not in _MOVING:
            continue
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")
        for name in ("limit", "mimic", "safety_controller"):
            for element in joint.findall(name):
                joint.remove(element)
        ET.SubElement(joint, "limit", lower="-1e9", upper="1e9", velocity="1e9", effort="1e9")
    return ET.tostring(robot, encoding="unicode")
