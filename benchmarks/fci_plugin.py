"""The plugin for the served FR3 of `fci_cell`: a cheap camera, one policy of TCP deltas under two
names, and one of joint velocities.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import ActionSpace, BackendSpec, PerceptionSpec

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

PLUGIN = "fci_plugin"
RATE_HZ = 20.0
CENTRE_M = (0.45, 0.0, 0.40)
SWAY_M = (0.06, 0.12, 0.08)
PERIODS_S = (7.0, 5.0, 11.0)
STEP_M = 0.008
"""Longest translation of one action; at 20 Hz that is 0.16 m/s."""

PATH_HZ, PATH_ROWS, CHUNK_ROWS = 15.0, 150, 30
"""Rows per second of the path, and the number of rows of the whole path and of one chunk."""
PATH_RAD = (0.30, -0.15, 0.20, -0.25, 0.10, 0.20, -0.30)
PATH_TURNS = (1, 2, 1, 2, 3, 1, 2)
"""Amplitude of each joint about its home posture, and number of oscillations."""


class SwayOptions(BaseModel):
    """Options of the policy."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    tag: int = Field(default=1, description="which of the two it is")


class BlankCamera:
    """Implements the protocol `PerceptionSource`: black images at `RATE_HZ`."""

    def __init__(self, config: None, topics: Topics, cameras: tuple[CameraProfile, ...]) -> None:
        self._topics, self._camera = topics, cameras[0]
        self._number = 0

    def open(self) -> None:
        """The first image is due now."""
        self._start_s = time.monotonic()

    def read(self, timeout_s: float) -> Frame:
        """The next image; its first four bytes number it, so that no two are equal."""
        import numpy as np

        from roboneuron.contract import Frame

        self._number += 1
        time.sleep(max(0.0, self._start_s + self._number / RATE_HZ - time.monotonic()))
        image = np.zeros((self._camera.height, self._camera.width, 3), dtype=np.uint8)
        image[0].reshape(-1)[:4] = np.frombuffer(self._number.to_bytes(4, "little"), dtype=np.uint8)
        now_ns, camera = self._topics.now_ns(), self._camera
        return Frame(camera=camera.name, image=image, stamp_ns=now_ns, frame_id=camera.frame_id)

    def close(self) -> None:
        """Nothing to release."""


class Sway:
    """Implements the protocol `Backend`: moves the TCP along a curve in front of the arm, with
    feedback.
    """

    def __init__(
        self, config: SwayOptions | None, runtime: Any = None, acceleration: Any = None
    ) -> None:
        self._options = config or SwayOptions()

    def load(self) -> None:
        """Nothing to load."""

    def predict(self, observation: Observation) -> ActionChunk:
        """One step towards the point of the curve at the image's time."""
        import numpy as np

        from roboneuron.contract import ActionChunk

        assert observation.ee_pose is not None
        at_s = observation.stamp_ns / 1e9
        aim_m = [
            c + a * math.sin(math.tau * at_s / p)
            for c, a, p in zip(CENTRE_M, SWAY_M, PERIODS_S, strict=True)
        ]
        way_m = np.array(aim_m) - observation.ee_pose.position_m
        way_m *= min(1.0, STEP_M / max(float(np.linalg.norm(way_m)), 1e-9))
        return ActionChunk(actions=np.array([[*way_m, 0.0, 0.0, 0.0, 1.0]]), step_s=1.0 / RATE_HZ)

    def reset(self) -> None:
        """Nothing to reset."""

    def close(self) -> None:
        """Nothing to release."""


def path_rad(row: float) -> list[float]:
    """Joints at a row of the path, which starts and ends at rest and at home [rad]."""
    from rn_robot_fr3.profile import HOME_RAD

    done = min(1.0, max(0.0, row / PATH_ROWS))
    smooth = done * done * (3.0 - 2.0 * done)
    return [
        home + far * math.sin(math.pi * turns * smooth) ** 2
        for home, far, turns in zip(HOME_RAD, PATH_RAD, PATH_TURNS, strict=True)
    ]


def path_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    """Control space of `JointPath`."""
    from roboneuron.contract import robot_space

    return robot_space("joint_velocity", profile, PATH_HZ)


class JointPath:
    """Implements the protocol `Backend`: the velocities of a known path, open loop; a row that is
    lost or sent twice shifts all later motion.
    """

    def __init__(self, config: None, runtime: Any = None, acceleration: Any = None) -> None:
        self._row = 0

    def load(self) -> None:
        """Compute the rows."""
        from rn_robot_fr3.profile import profile

        self._space = path_space({}, profile())

    def predict(self, observation: Observation) -> ActionChunk:
        """The next rows of the path; zeros after its end."""
        import numpy as np

        from roboneuron.contract import ActionChunk

        places = np.array([path_rad(self._row + i) for i in range(CHUNK_ROWS + 1)])
        self._row += CHUNK_ROWS
        rows = np.column_stack([np.diff(places, axis=0) * PATH_HZ, np.ones(CHUNK_ROWS)])
        note = "at the end" if self._row > PATH_ROWS else "on the way"
        return ActionChunk(actions=rows, step_s=1.0 / PATH_HZ, space=self._space, note=note)

    def reset(self) -> None:
        """Restart the path."""
        self._row = 0

    def close(self) -> None:
        """Nothing to release."""


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """One policy of TCP deltas under two names, and one of joint velocities."""
    path = BackendSpec(
        name="joint-path",
        summary="Follows a path of the joints.",
        target=f"{PLUGIN}:JointPath",
        action_space=ActionSpace(horizon=CHUNK_ROWS, step_s=1.0 / PATH_HZ),
        space=f"{PLUGIN}:path_space",
    )
    sways = [
        BackendSpec(
            name=name,
            summary="Sways before the arm.",
            target=f"{PLUGIN}:Sway",
            config=f"{PLUGIN}:SwayOptions",
            action_space=ActionSpace(step_s=1.0 / RATE_HZ),
            needs_state=True,
        )
        for name in ("sway", "swing")
    ]
    return [path, *sways]


@hookimpl
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:
    """Black images."""
    return [PerceptionSpec(name="blank", summary="Black images.", target=f"{PLUGIN}:BlankCamera")]
