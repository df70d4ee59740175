"""A plugin for tests: a cheap camera, a policy of joint velocities for two arms whose instruction
selects a fault of its answers, and one of joint positions with the same motion.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import BackendSpec, PerceptionSpec

if TYPE_CHECKING:
    from roboneuron.contract import (
        ActionChunk,
        CameraProfile,
        ControlSpace,
        Frame,
        Observation,
        RobotProfile,
        Topics,
    )

PLUGIN = "pair_policies_plugin"
RATE_HZ = 10.0
SPEED_RAD_S = 0.15


class NumberedCamera:
    """Follows the protocol `PerceptionSource`: distinguishable images, at `RATE_HZ`."""

    def __init__(self, config: None, topics: Topics, cameras: tuple[CameraProfile, ...]) -> None:
        self._topics, self._camera, self._number = topics, cameras[0], 0

    def open(self) -> None:
        """Make the first image due now."""
        self._start_s = time.monotonic()

    def read(self, timeout_s: float) -> Frame:
        """The next image."""
        import numpy as np

        from roboneuron.contract import Frame

        self._number += 1
        time.sleep(max(0.0, self._start_s + self._number / RATE_HZ - time.monotonic()))
        camera = self._camera
        image = np.full((camera.height, camera.width, 3), self._number % 256, dtype=np.uint8)
        return Frame(
            camera=camera.name,
            image=image,
            stamp_ns=self._topics.now_ns(),
            frame_id=camera.frame_id,
        )

    def close(self) -> None:
        """Do nothing."""


def waving_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    """Joint velocities of both arms."""
    from roboneuron.contract import robot_space

    return robot_space("joint_velocity", profile, RATE_HZ)


class Waving:
    """Follows the protocol `Backend`: oscillates every joint, until it answers wrongly."""

    def __init__(self, config: None, runtime: Any = None, acceleration: Any = None) -> None:
        self._number = 0

    def load(self) -> None:
        """Do nothing."""

    def reset(self) -> None:
        """Restart."""
        self._number = 0

    def close(self) -> None:
        """Do nothing."""

    def predict(self, observation: Observation) -> ActionChunk:
        """Two rows; from the eighth answer on the faulty ones selected by the instruction."""
        import numpy as np

        from rn_robot_fr3.profile import pair_profile
        from roboneuron.contract import GRIPPER, ActionChunk, ControlSpace, robot_space

        self._number += 1
        profile, fault = pair_profile(), observation.instruction
        space = robot_space("joint_velocity", profile, RATE_HZ)
        speed = SPEED_RAD_S if self._number % 16 < 8 else -SPEED_RAD_S
        row = np.array([1.0 if c.name == GRIPPER else speed for c in space.channels])
        if fault != "wave" and self._number >= 8:
            if fault == "fourteen values for one arm":
                left = tuple(c for c in space.channels if c.arm == "left")
                space = ControlSpace(kind=space.kind, channels=left, rate_hz=RATE_HZ)
                row = np.zeros(14)
            elif fault == "the wrong arm":
                channels = tuple(
                    type(c)(name=c.name, unit=c.unit, arm=c.arm.replace("right", "middle"))
                    for c in space.channels
                )
                space = ControlSpace(kind=space.kind, channels=channels, rate_hz=RATE_HZ)
            elif fault == "no number":
                row[9] = np.nan
            elif fault == "another space":
                space = robot_space("joint_position", profile)
                row[:] = 0.5
        return ActionChunk(actions=np.array([row, row]), step_s=1.0 / RATE_HZ, space=space)


def placing_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    """Joint positions of both arms."""
    from roboneuron.contract import robot_space

    return robot_space("joint_position", profile)


class Placing(Waving):
    """Follows the protocol `Backend`: oscillates every joint around its measured position."""

    def predict(self, observation: Observation) -> ActionChunk:
        """Two rows."""
        import numpy as np

        from rn_robot_fr3.profile import pair_profile
        from roboneuron.contract import GRIPPER, ActionChunk, robot_space

        assert observation.joints is not None
        self._number += 1
        space = robot_space("joint_position", pair_profile())
        speed = SPEED_RAD_S if self._number % 16 < 8 else -SPEED_RAD_S
        at = dict(zip(observation.joints.names, observation.joints.position, strict=True))
        rows = [
            [
                1.0 if c.name == GRIPPER else at[c.name] + speed * ahead / RATE_HZ
                for c in space.channels
            ]
            for ahead in (2, 3)
        ]
        return ActionChunk(actions=np.array(rows), step_s=1.0 / RATE_HZ, space=space)


@hookimpl
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:
    """The camera."""
    return [
        PerceptionSpec(
            name="numbered", summary="Images that differ.", target=f"{PLUGIN}:NumberedCamera"
        )
    ]


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """The policies."""
    return [
        BackendSpec(
            name="waving",
            summary="Moves both arms, until it answers wrongly.",
            target=f"{PLUGIN}:Waving",
            cameras=("primary",),
            space=f"{PLUGIN}:waving_space",
        ),
        BackendSpec(
            name="placing",
            summary="Moves both arms by positions.",
            target=f"{PLUGIN}:Placing",
            cameras=("primary",),
            needs_state=True,
            space=f"{PLUGIN}:placing_space",
        ),
    ]
