"""The simulated FR3 with protective stops: a file makes the arm stop by itself, like a reflex.

It simulates the worst allowed robot: after recovery it follows the next command at once, from any
sender.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lost_plugin import roboneuron_teleoperators

from rn_robot_fr3.driver import SimulatedFr3Driver
from rn_robot_fr3.options import SimulatedFr3Options
from rn_robot_fr3.profile import profile as fr3_profile
from roboneuron.contract import JointCommand, RobotProfile, RobotState
from roboneuron.errors import RefusedError, StateError, UnsafeError
from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import DriverSpec, PerceptionSpec, RobotSpec

NAME = "fr3r"
__all__ = ["roboneuron_teleoperators"]


class ReflexOptions(SimulatedFr3Options):
    """Options of the driver."""

    fault_file: str = ""


class ReflexDriver(SimulatedFr3Driver):
    """Stops by itself while the file exists; `recover` releases it once the file is gone."""

    def __init__(self, config: ReflexOptions | None, profile: RobotProfile, topics: Any) -> None:
        super().__init__(config, replace(profile, name="fr3"), topics)
        self._file = Path(config.fault_file) if config is not None and config.fault_file else None
        self._fault = ""

    def read(self) -> RobotState:
        """As the simulation's, with the fault."""
        if self._file is not None and self._file.exists() and not self._fault:
            self._fault = "reflex"
            self.hold()
        state = super().read()
        return replace(state, detail={**state.detail, "fault": self._fault})

    def send(self, command: JointCommand) -> JointCommand:
        """Refuse commands during the fault."""
        if self._fault:
            raise UnsafeError("The arm has stopped by itself: reflex.")
        return super().send(command)

    def recover(self) -> str:
        """Follow commands again."""
        if not self._fault:
            raise StateError("There is no fault.")
        if self._file is not None and self._file.exists():
            raise RefusedError("The cause of the reflex stands.")
        told, self._fault = self._fault, ""
        return told


def profile() -> RobotProfile:
    """Profile of the FR3."""
    return replace(fr3_profile(), name=NAME)


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """The FR3 with protective stops."""
    from rn_robot_fr3.plugin import roboneuron_robots as fr3_robots

    driver = DriverSpec(
        name="simulated",
        summary="The simulation, with reflexes",
        target="new_start_plugin:ReflexDriver",
        config="new_start_plugin:ReflexOptions",
        recovers=True,
    )
    fr3 = next(robot for robot in fr3_robots() if robot.name == "fr3")
    return [
        replace(fr3, name=NAME, target="new_start_plugin:profile", case=None, drivers=(driver,))
    ]


@hookimpl
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:
    """Its cameras."""
    from rn_robot_fr3.plugin import roboneuron_perceptions as fr3_perceptions

    cameras = next(iter(fr3_perceptions()))
    return [replace(cameras, name="fr3r-camera", robots=(NAME,), drivers=("simulated",), case=None)]
