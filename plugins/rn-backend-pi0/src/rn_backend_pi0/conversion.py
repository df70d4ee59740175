"""Conversion between an observation, the network and the contract, for TCP policies and joint
policies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rn_backend_pi0.joint_layout import JointLayout
from rn_vla.normalisation import Real
from rn_vla.rotation import F64
from rn_vla.tcp_profiles import Profile
from roboneuron import (
    ACTION_FIELDS,
    EE_DELTA,
    ControlSpace,
    Observation,
    UnsafeError,
)


class Conversion(Protocol):
    """Conversion of states and actions in one profile."""

    @property
    def space(self) -> ControlSpace:
        """Control space of a chunk's rows."""

    @property
    def step_s(self) -> float:
        """Time between two actions [s]."""

    @property
    def measured_joints(self) -> tuple[str, ...]:
        """Names of the joints that the state holds, in order."""

    @property
    def state_columns(self) -> tuple[str, ...]:
        """Meaning of each value of the state."""

    @property
    def action_columns(self) -> tuple[str, ...]:
        """Meaning of each value of an action."""

    @property
    def relative(self) -> NDArray[np.intp]:
        """Indices of the action values that are relative to the state value at the same index."""

    @property
    def precision(self) -> Real:
        """Number type in which state and actions are normalised."""

    def read_state(self, observation: Observation) -> F64:
        """Un-normalised state, float64 (n,). Raises UngroundedError or UnsafeError."""

    def to_contract(self, raw: F64, state: F64, observation: Observation) -> F64:
        """Convert un-normalised actions (H, n) to rows of `space`.

        Raises:
            UngroundedError, UnsafeError: a needed value is missing or not finite.
        """


@dataclass(frozen=True, slots=True, eq=False)
class TcpConversion:
    """For a policy whose actions move the TCP."""

    profile: Profile
    base_position_m: F64

    @property
    def space(self) -> ControlSpace:
        return EE_DELTA

    @property
    def step_s(self) -> float:
        return self.profile.action.step_s

    @property
    def measured_joints(self) -> tuple[str, ...]:
        return self.profile.state.joint_names

    @property
    def state_columns(self) -> tuple[str, ...]:
        return self.profile.state.columns

    @property
    def action_columns(self) -> tuple[str, ...]:
        return ACTION_FIELDS

    @property
    def relative(self) -> NDArray[np.intp]:
        return np.arange(6 if self.profile.action.adds_state else 0)

    @property
    def precision(self) -> Real:
        return np.dtype(np.float32)

    def read_state(self, observation: Observation) -> F64:
        return self.profile.state.build(observation)

    def to_contract(self, raw: F64, state: F64, observation: Observation) -> F64:
        return self.profile.action.to_contract(
            raw, state=state, pose=observation.ee_pose, base_position_m=self.base_position_m
        )


@dataclass(frozen=True, slots=True, eq=False)
class JointConversion:
    """For a policy whose actions move the joints called `joints`, in its own order.

    Attributes:
        layout: joint layout of the policy.
        joints: the robot's joint names.

    Raises:
        ConfigurationError: the names do not match the layout.
    """

    layout: JointLayout
    joints: tuple[str, ...]

    def __post_init__(self) -> None:
        self.layout.space(self.joints)

    @property
    def space(self) -> ControlSpace:
        return self.layout.space(self.joints)

    @property
    def step_s(self) -> float:
        return 1.0 / self.layout.rate_hz

    @property
    def measured_joints(self) -> tuple[str, ...]:
        return self.joints

    @property
    def state_columns(self) -> tuple[str, ...]:
        return self.layout.columns

    @property
    def action_columns(self) -> tuple[str, ...]:
        return self.layout.columns

    @property
    def relative(self) -> NDArray[np.intp]:
        return np.flatnonzero(~self.layout.grippers if self.layout.relative else [])

    @property
    def precision(self) -> Real:
        return np.dtype(np.float64)

    def read_state(self, observation: Observation) -> F64:
        return self.layout.to_network(self.layout.read_state(observation, self.joints))

    def to_contract(self, raw: F64, state: F64, observation: Observation) -> F64:
        if not np.isfinite(raw).all():
            raise UnsafeError("The model produced a non-finite value; nothing is executed.")
        return self.layout.to_contract(self.layout.to_robot(raw, state))
