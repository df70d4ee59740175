"""Sampling of joint-space paths, dense enough that checking the sampled postures checks the
path.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence

from roboneuron.contract import F64, RobotProfile, urdf_joints

_FINEST_M, _COARSEST_M = 0.005, 0.02
"""Bounds of the distance that a point of the arm may move between two samples. Each sample costs a
computation; a contact between two samples would be missed.
"""
_SHAPE_M = 0.1
"""Extent of a hand beyond the line of the joints."""


class Reach:
    """Sampling of paths in joint space.

    Between two samples no point of the arm moves farther than twice the least distance of its links
    (within 5 to 20 mm).
    """

    def __init__(self, profile: RobotProfile) -> None:
        """Args:
        profile: its description gives the levers, its collision bodies the distance.
        """
        self._levers = levers_m(profile)
        least_m = (
            _COARSEST_M if profile.collision is None else 2.0 * profile.collision.min_distance_m
        )
        self._spacing_m = min(_COARSEST_M, max(_FINEST_M, least_m))

    def count(self, names: Sequence[str], change: F64) -> int:
        """Number of steps for the absolute changes (n,) [rad or m] of the named joints; at
        least 1.
        """
        # the displacement of a point is at most the sum of the joints' contributions; a joint that
        # is not in the description counts 1 m per rad
        travel_m = sum(
            self._levers.get(n, 1.0) * d for n, d in zip(names, change.tolist(), strict=True)
        )
        return max(1, math.ceil(float(travel_m) / self._spacing_m))


def postures(
    start: F64, change: F64, count: int, slopes: tuple[F64, F64] | None = None
) -> Iterator[F64]:
    """Yield the `count` postures after `start` up to `start + change`, float64 (n,) each: on a
    line, or on the cubic with these slopes at its ends [rad or m in its whole time].
    """
    for number in range(1, count + 1):
        s = number / count
        passed = s * change
        if slopes is not None:
            passed = (
                s * s * (3.0 - 2.0 * s) * change
                + s * (1.0 - s) ** 2 * slopes[0]
                - s * s * (1.0 - s) * slopes[1]
            )
        yield start + passed


def levers_m(profile: RobotProfile) -> dict[str, float]:
    """Lever of each joint in the chain from base to TCP of each arm: largest displacement of a
    point [m per rad; 1 for prismatic joints], with what its followers move.

    Two arms approach each other by the sum of both displacements. Empty for a description without
    such a chain.
    """
    above = {_attribute(joint.find("child"), "link"): joint for joint in urdf_joints(profile.urdf)}
    kinds, levers = profile.kinds, dict[str, float]()
    for arm in profile.each_arm:
        # from the TCP down to the base, because each joint moves everything beyond it
        link, length, left = arm.tcp_link, _SHAPE_M, dict(above)
        while link in left and link != arm.base_link:
            joint = left.pop(link)
            name = _attribute(joint, "name")
            is_slide = name in kinds.prismatic
            levers[name] = 1.0 if is_slide else length
            origin = _attribute(joint.find("origin"), "xyz", "0 0 0")
            length += math.hypot(*map(float, origin.split()))
            if is_slide:
                length += kinds.farthest(name)
            link = _attribute(joint.find("parent"), "link")
    own = dict(levers)
    for follower in kinds.followers if levers else ():
        if follower.name in own:
            share = abs(follower.multiplier) * own[follower.name]
            levers[follower.leader] = levers.get(follower.leader, 0.0) + share
    return levers


def _attribute(element: ET.Element | None, name: str, default: str = "") -> str:
    return default if element is None else element.get(name, default)
