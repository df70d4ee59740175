"""What waits for the pose or the pictures of a robot that has ended says so, and what to call."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from roboneuron.config import LimitsConfig
from roboneuron.contract import RobotProfile
from roboneuron.errors import NotReadyError
from roboneuron.server.clock import RobotClock
from roboneuron.sight.inputs import why_no_image
from roboneuron.tools.arm.ee_move import MoveEndEffector
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.measured import MeasuredPose
from roboneuron.tools.arm.options import ArmToolsOptions


class Server:
    """A server whose robot is in a phase, and whose gate must not be asked."""

    graph = None

    def __init__(self, phase: str) -> None:
        starts = SimpleNamespace(stops=0, arm_stops=0, look=lambda: None, check=lambda stops: None)
        self.loop = SimpleNamespace(starts=starts, limits=LimitsConfig())
        self.config = SimpleNamespace(namespace="arm", robot=SimpleNamespace(name="arm"))
        view = SimpleNamespace(phase=phase, report=None)
        running = SimpleNamespace(phase="running", plan=SimpleNamespace(names={}))
        self.modules = SimpleNamespace(
            view=lambda kind: running if kind == "perception" else view,
            require_running=lambda kind: None,
        )
        self.gate = SimpleNamespace(
            check_free=lambda exposed: None,
            play=lambda *_, **__: pytest.fail("no motion begins without a pose"),
        )

    def subscribe(self, *_: Any) -> None: ...

    def clock(self, namespace: str) -> RobotClock:
        return RobotClock()


@pytest.mark.parametrize(
    ("phase", "call"), [("stopped", "start_robot"), ("exited", "start_robot"), ("running", "get_")]
)
def test_a_move_without_a_pose_begins_no_motion(phase: str, call: str) -> None:
    server: Any = Server(phase)
    profile = RobotProfile(name="arm", arm_joints=("j1",))
    tcp = MeasuredPose(server, "arm")
    exposed: Any = SimpleNamespace(
        robot="arm", namespace="arm", profile=profile, endpoint=SimpleNamespace(name="ee")
    )
    mover = EndEffectorMover(exposed, profile, server, ArmToolsOptions(), {"": tcp})

    async def run(work: Any, **_: Any) -> Any:
        return work(lambda _: None)

    context: Any = SimpleNamespace(who="agent", role="operator", simulated=False, run=run)
    with pytest.raises(NotReadyError) as caught:
        anyio.run(mover, MoveEndEffector(dz_m=0.01), context)
    assert call in caught.value.hint


@pytest.mark.parametrize("phase", ["stopped", "exited"])
def test_missing_pictures_of_a_robot_that_has_ended_name_the_robot(phase: str) -> None:
    server: Any = Server(phase)
    assert "start_robot" in why_no_image(server)
