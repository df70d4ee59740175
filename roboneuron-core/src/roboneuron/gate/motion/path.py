"""Sampling of paths in joint space: how far apart postures may be for a check of each to be a check
of the path.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence

from roboneuron.contract import F64, RobotProfile, urdf_joints

_FINEST_M, _COARSEST_M = 0.005, 0.02
"""Farthest that a point of the arm may move between two postures: each one costs a computation, and
one that is missed may be the one that touches.
"""
_SHAPE_M = 0.1
"""What a hand sticks out from the line of the joints."""


class Reach:
    """Sampling of paths in joint space.

    No point of the arm may move farther than twice the least distance of its links (within 5 to 20
    mm) from one posture to the next.
    """

    def __init__(self, profile: RobotProfile) -> None:
        """Args:
        profile: its description tells the levers, its collision bodies the distance.
        """
        self._levers = levers_m(profile)
        least_m = (
            _COARSEST_M if profile.collision is None else 2.0 * profile.collision.min_distance_m
        )
        self._spacing_m = min(_COARSEST_M, max(_FINEST_M, least_m))

    def count(self, names: Sequence[str], change: F64) -> int:
        """Into how many steps the absolute changes (n,) [rad or m] of the named joints are to be
        cut; at least 1.
        """
        # no point moves farther than the sum of what each joint moves it at most; a joint that the
        # description does not tell counts 1 m per rad
        travel_m = sum(
            self._levers.get(n, 1.0) * d for n, d in zip(names, change.tolist(), strict=True)
        )
        return max(1, math.ceil(float(travel_m) / self._spacing_m))


def levers_m(profile: RobotProfile) -> dict[str, float]:
    """By joint of the chain from base to TCP of each arm: metres that a point moves at most per rad
    (1 per m for slides).

    Two arms come nearer to each other by the sum of what both move. Empty for a description that
    holds no such chain.
    """
    above = {_attribute(joint.find("child"), "link"): joint for joint in urdf_joints(profile.urdf)}
    levers: dict[str, float] = {}
    for arm in profile.each_arm:
        # from the TCP down to the base, because each joint moves all that lies behind it
        link, length, left = arm.tcp_link, _SHAPE_M, dict(above)
        while link in left and link != arm.base_link:
            joint = left.pop(link)
            is_slide = _attribute(joint, "type") == "prismatic"
            levers[_attribute(joint, "name")] = 1.0 if is_slide else length
            origin = _attribute(joint.find("origin"), "xyz", "0 0 0")
            length += math.hypot(*map(float, origin.split()))
            if is_slide:
                limit = joint.find("limit")
                length += abs(
                    float(_attribute(limit, "upper", "1")) - float(_attribute(limit, "lower", "-1"))
                )
            link = _attribute(joint.find("parent"), "link")
    return levers


def _attribute(element: ET.Element | None, name: str, default: str = "") -> str:
    return default if element is None else element.get(name, default)
