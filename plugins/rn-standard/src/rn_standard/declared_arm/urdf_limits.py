"""Limits of an arm's joints from its description, with careful values where it has none."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass

from rn_standard.declared_arm.urdf_tree import UrdfTree
from roboneuron import ConfigurationError

SLOW_RAD_S, SLOW_M_S = 0.5, 0.05
"""Velocity limit of a joint whose description has none."""
RISE_S = 0.5
"""A joint reaches its velocity limit in this time: no description has accelerations."""
WEAK = 1.0
"""Effort limit of a joint whose description has none [Nm or N]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LimitRow:
    """Limits of one joint, in radians or metres: as `roboneuron.JointLimits`."""

    joint: str
    lower: float
    upper: float
    velocity: float
    acceleration: float
    effort: float


def read_limits(tree: UrdfTree, joints: Sequence[str]) -> tuple[list[LimitRow], list[str]]:
    """Limits of the joints, and one sentence for each kind of limit that was made up.

    Raises:
        ConfigurationError: joints that are not continuous have no range; names them all.
    """
    efforts = _efforts(tree.urdf)
    rows, slow, weak, rangeless = [], [], [], []
    for joint in joints:
        lower, upper = tree.kinds.limits(joint)
        is_turning = joint in tree.kinds.continuous
        if not is_turning and not (math.isfinite(upper - lower) and lower < upper):
            rangeless.append(f"{joint} ({lower:g} .. {upper:g})")
            continue
        velocity = abs(tree.kinds.velocity_limit(joint))
        if not (velocity > 0 and math.isfinite(velocity)):
            velocity = SLOW_M_S if joint in tree.kinds.prismatic else SLOW_RAD_S
            slow.append(joint)
        effort = efforts.get(joint, 0.0)
        if not (effort > 0 and math.isfinite(effort)):
            effort = WEAK
            weak.append(joint)
        rows.append(
            LimitRow(
                joint=joint,
                lower=lower,
                upper=upper,
                velocity=velocity,
                acceleration=velocity / RISE_S,
                effort=effort,
            )
        )
    if rangeless:
        raise ConfigurationError(
            f"These joints have no range of positions: {', '.join(rangeless)}.",
            hint='Write lower and upper into their <limit>; type="continuous" if a joint turns '
            "without end.",
        )
    notes = [f"acceleration: a URDF has none; taken as the velocity limit in {RISE_S:g} s"]
    if slow:
        notes.append(
            f"velocity of {', '.join(slow)}: the URDF has none; taken as {SLOW_RAD_S:g} rad/s "
            f"({SLOW_M_S:g} m/s)"
        )
    if weak:
        notes.append(f"effort of {', '.join(weak)}: the URDF has none; taken as {WEAK:g} Nm (N)")
    return rows, notes


def _efforts(urdf: str) -> dict[str, float]:
    found = {}
    for joint in ElementTree.fromstring(urdf).findall("joint"):
        limit = joint.find("limit")
        text = "0" if limit is None else limit.get("effort", "0")
        try:
            found[joint.get("name", "")] = float(text)
        except ValueError as error:
            raise ConfigurationError(
                f"URDF joint {joint.get('name')!r}: its effort is {text!r}, expected a number."
            ) from error
    return found
