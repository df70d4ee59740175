"""How far from a joint's axis the arm can reach: bounds how far any point of it moves when the joint does."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

from roboneuron.contract import RobotProfile

_SHAPE_M = 0.1
"""What a hand sticks out from the line of the joints."""


def levers_m(profile: RobotProfile) -> dict[str, float]:
    """By joint of the chain from base to TCP: metres that a point moves at most per rad (1 per m for slides).

    Empty for a description that holds no such chain.
    """
    try:
        root = ET.fromstring(profile.urdf)
    except ET.ParseError:
        return {}
    above = {_attribute(joint.find("child"), "link"): joint for joint in root.findall("joint")}
    levers: dict[str, float] = {}
    link, length = profile.tcp_link, _SHAPE_M
    while link in above and link != profile.base_link:
        joint = above.pop(link)
        is_slide = joint.get("type") == "prismatic"
        levers[joint.get("name", "")] = 1.0 if is_slide else length
        length += math.hypot(*map(float, _attribute(joint.find("origin"), "xyz", "0 0 0").split()))
        if is_slide:
            limit = joint.find("limit")
            length += abs(float(_attribute(limit, "upper", "1")) - float(_attribute(limit, "lower", "-1")))
        link = _attribute(joint.find("parent"), "link")
    return levers


def _attribute(element: ET.Element | None, name: str, default: str = "") -> str:
    return default if element is None else element.get(name, default)
