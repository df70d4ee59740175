"""Named conventions of public pi0 checkpoints: what state they take and what their actions mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from rn_backend_pi0.action_layout import ActionLayout
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
