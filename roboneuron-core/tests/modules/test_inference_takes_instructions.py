"""Instructions and other parameters of a running inference module."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from inference_cell import Cell
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from rn_testing.waiting import holds_within
from roboneuron.contract import JointSample, Pose
from roboneuron.ros.messages import to_joint_state, to_pose_stamped

pytestmark = pytest.mark.ros


def test_new_instruction_cuts_a_chunk_short_and_resets_the_backend(
    make_inference: Callable[..., Cell],
) -> None:
    cell = make_inference("chunked")
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)
    resets = cell.inference.module.backend.resets
    assert cell.instruct("something else").successful
    assert not holds_within(lambda: len(cell.actions) >= 5, 0.3)
    assert cell.status()["actions_for_instruction"] == "0"
    cell.send_image()
    assert holds_within(lambda: cell.inference.module.backend.resets == resets + 1)


def test_without_an_instruction_it_is_ready_and_still(make_inference: Callable[..., Cell]) -> None:
    cell = make_inference("instant", replace={'instruction = "go"': 'instruction = ""'})
    cell.send_image()
    assert holds_within(lambda: cell.status()["ready"] == "true")
    assert not cell.actions
    assert cell.instruct("go").successful
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)


@pytest.mark.parametrize("value", ["x" * 1001, 7])
def test_instruction_that_is_no_sentence_is_refused(
    make_inference: Callable[..., Cell], value: Any
) -> None:
    cell = make_inference("instant")
    assert not cell.instruct(value).successful
    assert cell.status()["instruction"] == "go"


def test_instruction_that_cannot_be_grounded_is_an_error_without_motion(
    make_inference: Callable[..., Cell],
) -> None:
    cell = make_inference("picky")
    states = cell.world.publisher(JointState, "joint_states")
    poses = cell.world.publisher(PoseStamped, "ee_pose")

    def send_all() -> bool:
        now_ns = cell.world.node.get_clock().now().nanoseconds
        states.publish(
            to_joint_state(JointSample(names=("a",), position=np.zeros(1), stamp_ns=now_ns))
        )
        pose = Pose(
            position_m=np.zeros(3), quaternion_xyzw=np.array([0, 0, 0, 1.0]), stamp_ns=now_ns
        )
        poses.publish(to_pose_stamped(pose, "base"))
        cell.send_image()
        return cell.status()["error_code"] == "ungrounded"

    assert holds_within(send_all)
    assert not cell.actions
    assert cell.instruct("the red one").successful
    assert holds_within(lambda: not send_all() and len(cell.actions) > 0)


def test_a_parameter_of_another_type_is_refused(make_inference: Callable[..., Cell]) -> None:
    cell = make_inference("instant")
    for name, value in (("instruction", 5), ("act_from_ns", "now")):
        answer = cell.world.run(
            lambda n=name, v=value: cell.inference.set_parameters([Parameter(n, value=v)])
        )[0]
        assert not answer.successful
        assert "type" in answer.reason


def test_a_parameter_that_its_feature_refuses_changes_nothing(
    make_inference: Callable[..., Cell],
) -> None:
    cell = make_inference("instant")
    parameters = [Parameter("act_from_ns", value=5), Parameter("act_until_ns", value=-1)]
    result = cell.world.run(lambda: cell.inference.set_parameters_atomically(parameters))
    assert not result.successful
    assert result.reason == "no ROS time"
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)


@pytest.mark.parametrize("is_replaced", [True, False])
def test_a_failure_of_a_replaced_instruction_is_no_error_of_the_new_one(
    make_inference: Callable[..., Cell], request: pytest.FixtureRequest, is_replaced: bool
) -> None:
    cell = make_inference("moody", replace={'instruction = "go"': 'instruction = "fail"'})
    backend = cell.inference.module.backend
    request.addfinalizer(backend.may_answer.set)
    backend.may_answer.clear()
    assert cell.send_until(backend.asked.is_set)
    if is_replaced:
        assert cell.instruct("go").successful
    backend.may_answer.set()
    if is_replaced:
        assert holds_within(lambda: cell.status().get("dropped.withdrawn_chunk") == "1")
        assert cell.status()["error_count"] == "0"
        assert cell.send_until(lambda: len(cell.actions) > 0)
    else:
        assert holds_within(lambda: cell.status()["error_code"] == "ungrounded")
