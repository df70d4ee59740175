"""A backend that answers immediately, and observations for it."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rn_testing.fakes.perception import gradient_image
from rn_testing.fakes.robot import gantry_profile
from roboneuron import (
    ActionChunk,
    ActionSpace,
    AnyAcceleration,
    AnyRuntime,
    BackendSpec,
    Frame,
    InvalidInputError,
    JointSample,
    Observation,
    Pose,
    StateError,
    UnsafeError,
)


class InstantOptions(BaseModel):
    """Options of the instant backend."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    delta_m: float = Field(default=0.001, description="translation along x per action [m]")
    horizon: int = Field(default=1, ge=1, le=16, description="actions per chunk")
    step_s: float = Field(default=0.1, gt=0, description="time between two actions [s]")


class InstantBackend:
    """Follows the protocol `Backend`: always a small move along x, immediately."""

    def __init__(
        self,
        config: InstantOptions | None,
        runtime: AnyRuntime | None = None,
        acceleration: AnyAcceleration | None = None,
    ) -> None:
        self._options = config or InstantOptions()
        self._loaded = False

    def load(self) -> None:
        """Mark it as loaded."""
        self._loaded = True

    def predict(self, observation: Observation) -> ActionChunk:
        """Return the same chunk for every observation with a primary frame and finite
        proprioception.
        """
        if not self._loaded:
            raise StateError("The backend is not loaded; call load() first.")
        if "primary" not in observation.frames:
            raise InvalidInputError(
                "The observation has no frame of role 'primary'.", path="frames"
            )
        if observation.joints is None:
            raise InvalidInputError("The observation has no joints.", path="joints")
        if not np.isfinite(observation.joints.position).all():
            raise UnsafeError("The observation holds a joint position that is not finite.")
        action = np.array([self._options.delta_m, 0, 0, 0, 0, 0, 1.0])
        return ActionChunk(
            actions=np.tile(action, (self._options.horizon, 1)), step_s=self._options.step_s
        )

    def reset(self) -> None:
        """Do nothing; there is no state."""

    def close(self) -> None:
        """Unload."""
        self._loaded = False


def make_observation(spec: BackendSpec, instruction: str = "pick up the red cube") -> Observation:
    """An observation with exactly the inputs that `spec` declares: gradient images, and the gantry
    at home as state.
    """
    frames = {
        role: Frame(
            camera=role,
            image=gradient_image(320, 240, 40 * i),
            stamp_ns=1_000_000,
            frame_id=f"{role}_optical",
        )
        for i, role in enumerate(spec.cameras)
    }
    if not spec.needs_state:
        return Observation(frames=frames, instruction=instruction, stamp_ns=1_000_000)
    profile = gantry_profile()
    assert profile.home_rad is not None
    return Observation(
        frames=frames,
        instruction=instruction,
        joints=JointSample(names=profile.arm_joints, position=profile.home_rad, stamp_ns=1_000_000),
        ee_pose=Pose(
            position_m=np.array([0.4, 0.0, 0.4]), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0])
        ),
        gripper_open=1.0,
        stamp_ns=1_000_000,
    )


FAKE_BACKEND = BackendSpec(
    name="instant",
    summary="Answers at once with a small move along x.",
    target="rn_testing.fakes.backend:InstantBackend",
    config="rn_testing.fakes.backend:InstantOptions",
    needs_state=True,
    action_space=ActionSpace(horizon=16),
)
"""Descriptor of the instant backend."""
