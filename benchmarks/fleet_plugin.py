"""The plugin of bench_fleet.py: a mobile base that does not move and notes the arrival of each
command.

A command carries its number in `linear.y`. A note is 24 bytes: CLOCK_MONOTONIC [ns] as int64,
`linear.x` and the number as float64. A `hold` of the driver is noted as speed 0 and number -1:
after an emergency stop a robot module holds, and passes no more commands to its driver, including
the zero of the server.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import DriverSpec, RobotSpec

if TYPE_CHECKING:
    from roboneuron.contract import RobotProfile, RobotState, Topics

NAME = "light-base"
NOTE = struct.Struct("<qdd")
MOST_NUMBER = 1e9
REPEAT_HZ = 10.0


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """One base."""
    driver = DriverSpec(
        name="simulated",
        summary="notes commands",
        target="fleet_plugin:Light",
        config="fleet_plugin:LightOptions",
    )
    return [
        RobotSpec(
            name=NAME,
            summary="a base without physics",
            target="fleet_plugin:profile",
            drivers=(driver,),
        )
    ]


class LightOptions(BaseModel):
    """Options of the driver."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    notes: str = Field(description="file that arrivals are appended to")


def profile() -> RobotProfile:
    """A base that takes repeated velocities while they last, and stops with zero."""
    from roboneuron.contract import Endpoint, RobotProfile

    bounds = {"linear.x": (-1.0, 1.0), "linear.y": (0.0, MOST_NUMBER), "angular.z": (-1.0, 1.0)}
    velocity = Endpoint(
        name="velocity",
        kind="publish",
        topic="cmd_vel",
        type="geometry_msgs/msg/Twist",
        summary="Drive.",
        bounds=bounds,
        stop_message="zero",
        repeat_hz=REPEAT_HZ,
    )
    return RobotProfile(name=NAME, base_link="base_link", endpoints=(velocity,))


class Light:
    """Implements the protocol `RobotDriver`."""

    def __init__(self, config: LightOptions, profile: RobotProfile, topics: Topics) -> None:
        self._path = config.notes
        self._topics = topics
        self._file = -1

    def open(self) -> None:
        """Subscribe to commands."""
        from geometry_msgs.msg import Twist

        self._file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        self._topics.subscribe("cmd_vel", Twist, self._note)

    def _note(self, message: Any) -> None:
        os.write(self._file, NOTE.pack(time.monotonic_ns(), message.linear.x, message.linear.y))

    def read(self) -> RobotState:
        """State of one wheel at rest."""
        import numpy as np

        from roboneuron.contract import JointSample, RobotState

        still = np.zeros(1)
        return RobotState(
            joints=JointSample(
                names=("wheel",), position=still, velocity=still, stamp_ns=self._topics.now_ns()
            )
        )

    def send(self, command: Any) -> Any:
        """Do nothing: a base has no joints."""
        return command

    def hold(self) -> None:
        """Note the hold, at which a real base would brake."""
        if self._file >= 0:
            os.write(self._file, NOTE.pack(time.monotonic_ns(), 0.0, -1.0))

    def close(self) -> None:
        """Leave the file open: the process ends next, and late commands should be noted too."""
