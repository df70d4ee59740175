"""Named conventions of public pi0 checkpoints: what state they take and what their actions mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from rn_backend_pi0.action_layout import ActionLayout
from rn_backend_pi0.joint_layout import JointLayout
from rn_backend_pi0.state import StateLayout
from rn_vla.rotation import DOWN_ROTVEC_RAD


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Profile:
    """State and actions of one family of checkpoints."""

    state: StateLayout
    action: ActionLayout


_LIBERO_STATE = StateLayout(
    terms=("position", "rotvec", "fingers"),
    rotvec_near_rad=np.array(DOWN_ROTVEC_RAD),
    finger_travel_m=0.04,
)
_LIBERO_ACTION = ActionLayout(
    meaning="delta",
    frame="base",
    rotation="rotvec",
    translation_scale_m=0.05,
    rotation_scale_rad=0.5,
    limit=1.0,
    gripper="signed_close",
    step_s=0.05,
)
_LIBERO_ACTION_RELATIVE = ActionLayout(
    meaning="delta",
    frame="base",
    rotation="rotvec",
    translation_scale_m=0.05,
    rotation_scale_rad=0.5,
    limit=1.0,
    adds_state=True,
    gripper="signed_close",
    step_s=0.05,
)
_BRIDGE = Profile(
    state=StateLayout(
        terms=("position", "rpy_by_down", "padding", "gripper_open"),
    ),
    action=ActionLayout(
        meaning="delta", frame="base", rotation="rpy", gripper="open_fraction", step_s=0.2
    ),
)

PROFILES: Mapping[str, Profile] = MappingProxyType(
    {
        "libero": Profile(state=_LIBERO_STATE, action=_LIBERO_ACTION),
        "libero-openpi": Profile(state=_LIBERO_STATE, action=_LIBERO_ACTION_RELATIVE),
        "bridge": _BRIDGE,
    }
)
"""Profile by name.

"libero": actions are inputs of robosuite's OSC_POSE controller, clipped to -1..1, 0.05 m and 0.5
rad a unit, applied on the left in world axes at 20 Hz; gripper -1 open, 1 closed. State: TCP
position, rotation vector (gripper down is near (pi, 0, 0)), two finger joints. Source: robosuite
controllers/osc.py, LIBERO env_wrapper.py (control_freq 20), openpi examples/libero.
"libero-openpi": the same, but the network's output is relative to the state. Source: openpi
training/config.py, extra_delta_transform of pi0_libero. openpi's policy server adds the state
itself, so the remote backend uses "libero". "bridge": metres and radians at 5 Hz, rotation as roll,
pitch, yaw, gripper 1 open; the rotation of the state is taken against a gripper that points down.
Source: see `rn_vla.rotation.rpy_by_down`.
"""

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
"""Layout by name, of policies that act on joints, from the base to the tip.

"droid": joint velocities at 15 Hz. They are shares of the greatest step of DROID's software, 0.2
rad in one period, so 1 is 3 rad/s; clipped to -1..1 as openpi's example does. Gripper 0 open, 1
closed. Source: droid robot_ik_solver.py, openpi examples/droid. "droid-position": the same data
with joint positions as targets. "franka", "ur5e": the spaces of the base models, 20 Hz, gripper 0
open, 1 closed. Source: openpi docs/norm_stats.md. "aloha": two arms at 50 Hz; the base models have
other signs of three joints than ALOHA's software, and the gripper's angle. "-plain": trained on
ALOHA's own values (`adapt_to_pi` is false). "-absolute": trained without deltas.
"""
