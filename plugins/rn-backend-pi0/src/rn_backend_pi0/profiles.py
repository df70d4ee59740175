"""Named conventions of public pi0 checkpoints with joint actions; those that move the TCP are in
`rn_vla.tcp_profiles`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from rn_backend_pi0.joint_layout import JointLayout

_ALOHA_SIGNS = (1, -1, -1, 1, 1, 1)
_ALOHA_ARMS = ("left", "right")


def _aloha(*, adapted: bool, relative: bool) -> JointLayout:
    return JointLayout(
        kind="joint_position",
        joints=6,
        rate_hz=50.0,
        gripper="open_fraction",
        arms=_ALOHA_ARMS,
        relative=relative,
        signs=_ALOHA_SIGNS if adapted else (),
        angular=adapted,
    )


JOINT_PROFILES: Mapping[str, JointLayout] = MappingProxyType(
    {
        "droid": JointLayout(
            kind="joint_velocity",
            joints=7,
            rate_hz=15.0,
            gripper="closed_fraction",
            limit=1.0,
            scale=0.2 * 15.0,
        ),
        "droid-position": JointLayout(
            kind="joint_position", joints=7, rate_hz=15.0, gripper="closed_fraction", relative=True
        ),
        "franka": JointLayout(
            kind="joint_position", joints=7, rate_hz=20.0, gripper="closed_fraction", relative=True
        ),
        "ur5e": JointLayout(
            kind="joint_position", joints=6, rate_hz=20.0, gripper="closed_fraction", relative=True
        ),
        "aloha": _aloha(adapted=True, relative=True),
        "aloha-absolute": _aloha(adapted=True, relative=False),
        "aloha-plain": _aloha(adapted=False, relative=True),
        "aloha-plain-absolute": _aloha(adapted=False, relative=False),
    }
)
"""Layout by name, for policies with joint actions, from the base to the tip.

"droid": joint velocities at 15 Hz. They are fractions of the largest step of DROID's software, 0.2
rad in one period, so 1 is 3 rad/s; clipped to -1..1 as openpi's example does. Gripper 0 open, 1
closed. Source: droid robot_ik_solver.py, openpi examples/droid. "droid-position": the same data
with joint positions as targets. "franka", "ur5e": the spaces of the base models, 20 Hz, gripper 0
open, 1 closed. Source: openpi docs/norm_stats.md. "aloha": two arms at 50 Hz; the base models use
opposite signs for three joints of ALOHA's software, and the gripper's angle. "-plain": trained on
ALOHA's own values (`adapt_to_pi` is false). "-absolute": trained without deltas.
"""
