"""Named conventions of public policies that move the TCP, for their state and actions; and the
options that define others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_vla.rotation import DOWN_ROTVEC_RAD
from rn_vla.tcp_actions import ActionLayout, FrameName, Gripper, Meaning, Rotation
from rn_vla.tcp_state import StateLayout, StateTerm

Vector = tuple[float, float, float]


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
_LIBERO_ACTION_RELATIVE = replace(_LIBERO_ACTION, adds_state=True)
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
rad per unit, applied from the left in world axes at 20 Hz; gripper -1 open, 1 closed. State: TCP
position, rotation vector (gripper down is near (pi, 0, 0)), two finger joints. Source: robosuite
controllers/osc.py, LIBERO env_wrapper.py (control_freq 20), openpi examples/libero.
"libero-openpi": the same, but the network's output is relative to the state. Source: openpi
training/config.py, extra_delta_transform of pi0_libero. openpi's policy server adds the state
itself, so the remote backend uses "libero". "bridge": metres and radians at 5 Hz, rotation as roll,
pitch, yaw, gripper 1 open; the rotation of the state is relative to a gripper that points down.
Source: see `rn_vla.rotation.rpy_by_down`.
"""


class OptionSection(BaseModel):
    """Base class of options: no unknown keys, no infinities, immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class StateOptions(OptionSection):
    """The state vector of an own profile."""

    terms: tuple[StateTerm, ...] = Field(
        min_length=1, description="parts of the state vector, in order"
    )
    joint_names: tuple[str, ...] = Field(
        default=(), description="joints of the term 'joints', in order"
    )
    rotvec_near_rad: Vector = Field(
        default=(0.0, 0.0, 0.0), description="choose the rotation vector nearer to this [rad]"
    )
    finger_travel_m: float = Field(
        default=0.04, gt=0, description="position of one finger joint when open [m]"
    )

    @model_validator(mode="after")
    def _joints_are_named(self) -> Self:
        if ("joints" in self.terms) != bool(self.joint_names):
            raise ValueError("joint_names must be given exactly when terms has 'joints'")
        return self


class ActionOptions(OptionSection):
    """The action values of an own profile."""

    meaning: Meaning = Field(description="'delta' is relative, 'absolute' is a target pose")
    frame: FrameName = Field(description="axes of a delta: 'base' or 'tcp'")
    rotation: Rotation = Field(description="'rotvec', or 'rpy' about fixed axes")
    gripper: Gripper = Field(description="meaning of the last value")
    step_s: float = Field(gt=0, le=10, description="time between two actions [s]")
    translation_scale_m: float = Field(default=1.0, gt=0, description="metres per unit")
    rotation_scale_rad: float = Field(default=1.0, gt=0, description="radians per unit")
    limit: float = Field(
        default=0.0, ge=0, description="clip the first six values to +-limit; 0 for no clipping"
    )
    adds_state: bool = Field(
        default=False, description="the first six values are relative to the state"
    )


def own_profile(state: StateOptions, action: ActionOptions) -> Profile:
    """The profile defined by options."""
    return Profile(state=own_state(state), action=ActionLayout(**action.model_dump()))


def own_state(state: StateOptions) -> StateLayout:
    """The state vector defined by options."""
    return StateLayout(
        terms=state.terms,
        joint_names=state.joint_names,
        rotvec_near_rad=np.array(state.rotvec_near_rad),
        finger_travel_m=state.finger_travel_m,
    )
