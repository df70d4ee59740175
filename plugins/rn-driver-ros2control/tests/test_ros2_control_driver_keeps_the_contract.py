"""Every rule of robot drivers, on the FR3 driven through a stand-in controller, in each mode."""

from __future__ import annotations

import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from rn_robot_fr3.plugin import roboneuron_robots
from rn_testing.cases import RobotCase
from rn_testing.contracts import RobotContract


@pytest.mark.usefixtures("rig")
class TestByTopic(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        options = {"gripper": "gripper-command"}
        return RobotCase(spec=roboneuron_robots()[0], driver="ros2-control", driver_options=options)


@pytest.mark.usefixtures("rig")
@pytest.mark.sampled(every=4)
class TestByChunks(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        options = {"gripper": "gripper-command", "mode": "chunks"}
        return RobotCase(spec=roboneuron_robots()[0], driver="ros2-control", driver_options=options)


@pytest.mark.usefixtures("rig")
@pytest.mark.sampled(every=4)
class TestByAction(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        options = {"gripper": "gripper-command", "mode": "action", "interpolation": "cubic"}
        return RobotCase(spec=roboneuron_robots()[0], driver="ros2-control", driver_options=options)


@pytest.mark.usefixtures("rig")
@pytest.mark.sampled(every=4)
class TestByForwarding(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        options = {"gripper": "gripper-command", "controller_type": "forward-position"}
        return RobotCase(spec=roboneuron_robots()[0], driver="ros2-control", driver_options=options)
