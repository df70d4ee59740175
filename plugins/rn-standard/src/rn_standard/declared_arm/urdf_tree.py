"""The tree of links and joints of a robot description that a person brings."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator

from rn_standard.declared_arm.urdf_joints import MOVABLE, UrdfJoint, read_joints
from roboneuron import ConfigurationError, JointKinds, nearest

_FIXED = "fixed"


class UrdfTree:
    """Links and joints of one description, which is checked when it is made.

    Attributes:
        urdf: the description.
        root: the link that hangs from no joint.
        links: names of all links.
        kinds: what positions of its joints mean.
    """

    def __init__(self, urdf: str) -> None:
        """Args:
        urdf: XML text.

        Raises:
            ConfigurationError: it is no URDF, its links are no tree, or no joint of it moves.
        """
        robot = _parse(urdf)
        self.urdf = urdf
        self.kinds = JointKinds.of(urdf)
        self.links = tuple(link.get("name", "") for link in robot.findall("link"))
        try:
            found = read_joints(urdf)
        except ValueError as error:
            raise ConfigurationError(f"The robot description cannot be read: {error}") from error
        self._above = found
        self._by_name = {joint.name: (parent, joint) for parent, joint in found.values()}
        self._check_names(robot)
        if not self.links:
            raise ConfigurationError("The robot description has no links.")
        roots = [link for link in self.links if link not in found]
        if len(roots) != 1:
            raise ConfigurationError(
                f"The robot description has {len(roots)} links that hang from no joint"
                f"{': ' if roots else ''}{', '.join(roots)}; expected one.",
                hint="Connect the others by fixed joints, or take them out.",
            )
        self.root = roots[0]
        self.followers = {f.name: f.leader for f in self.kinds.followers}
        if not self.leaders():
            raise ConfigurationError(
                "No joint of the robot description moves by itself.",
                hint="An arm has revolute, continuous or prismatic joints.",
            )

    def _check_names(self, robot: ElementTree.Element) -> None:
        joints = [joint.get("name", "") for joint in robot.findall("joint")]
        children = [_child(joint) for joint in robot.findall("joint")]
        for what, names in (("links", self.links), ("joints", joints)):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ConfigurationError(
                    f"The robot description has two {what} named {twice[0]!r}."
                )
        for child in children:
            if children.count(child) > 1:
                raise ConfigurationError(f"The link {child!r} hangs from two joints.")
        for parent, joint in self._above.values():
            for link in (parent, joint.child):
                if link not in self.links:
                    raise ConfigurationError(
                        f"The joint {joint.name!r} connects the link {link!r}, which the robot "
                        "description does not have.",
                        hint=nearest(link, self.links),
                    )

    def check_link(self, name: str, option: str) -> None:
        """Raise ConfigurationError unless there is this link."""
        if name not in self.links:
            raise ConfigurationError(
                f"{option}: the robot description has no link {name!r}.",
                hint=nearest(name, self.links) or f"Its links are {', '.join(self.links)}.",
            )

    def check_joint(self, name: str, option: str) -> None:
        """Raise ConfigurationError unless there is this joint, and it moves by itself."""
        if name not in self._by_name or name not in self.leaders():
            why = "that moves by itself" if name in self._by_name else ""
            raise ConfigurationError(
                f"{option}: the robot description has no joint {name!r} {why}".rstrip() + ".",
                hint=nearest(name, self.leaders())
                or f"Its joints are {', '.join(self.leaders())}.",
            )

    def leaders(self) -> tuple[str, ...]:
        """Joints that move and follow no other one."""
        return tuple(name for name in self.kinds.moving if name not in self.followers)

    def joint(self, name: str) -> UrdfJoint:
        """The joint of that name."""
        return self._by_name[name][1]

    def parent(self, name: str) -> str:
        """The link that carries a joint."""
        return self._by_name[name][0]

    def chain(self, link: str) -> list[UrdfJoint]:
        """The joints from the root to a link.

        Raises:
            ConfigurationError: the joints go round in a circle.
        """
        found: list[UrdfJoint] = []
        while link in self._above:
            link, joint = self._above[link]
            found.append(joint)
            if len(found) > len(self._above):
                raise ConfigurationError(f"The link {link!r} hangs from itself.")
        return found[::-1]

    def arm_joints(self, link: str) -> list[str]:
        """The joints that move by themselves between the root and a link, base to tip."""
        return [
            joint.name
            for joint in self.chain(link)
            if joint.kind in MOVABLE and joint.name not in self.followers
        ]

    def below(self, link: str) -> list[UrdfJoint]:
        """The joints that a link carries."""
        return [joint for parent, joint in self._above.values() if parent == link]

    def rigid(self, link: str) -> Iterator[str]:
        """A link and those that fixed joints connect to it downwards, near ones first."""
        yield link
        for joint in self.below(link):
            if joint.kind == _FIXED:
                yield from self.rigid(joint.child)

    def descendants(self, joint: str) -> Iterator[UrdfJoint]:
        """The joints that hang from a joint."""
        for other in self.below(self.joint(joint).child):
            yield other
            yield from self.descendants(other.name)


def _parse(urdf: str) -> ElementTree.Element:
    try:
        robot = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise ConfigurationError(f"The robot description is not XML: {error}.") from error
    if robot.tag != "robot":
        raise ConfigurationError(
            f"The robot description is a <{robot.tag}>, expected a URDF <robot>."
        )
    if any("xacro" in element.tag for element in robot.iter()):
        raise ConfigurationError(
            "The robot description is a xacro that is not expanded.",
            hint="Write its output: xacro arm.urdf.xacro > arm.urdf",
        )
    return robot


def _child(joint: ElementTree.Element) -> str:
    child = joint.find("child")
    return "" if child is None else child.get("link", "")
