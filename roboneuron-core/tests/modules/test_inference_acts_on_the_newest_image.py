"""The inference module, judged by its published actions and its reports."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from inference_cell import Cell
from rclpy.duration import Duration
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from rn_testing.waiting import holds_within
from roboneuron.contract import JointSample, Pose
from roboneuron.ros.messages import to_joint_state, to_pose_stamped

pytestmark = pytest.mark.ros


def test_an_image_becomes_one_labelled_action(make_inference: Callable[..., Cell]) -> None:
    cell = make_inference("instant")
    assert cell.status()["ready"] == "false"
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)
    assert list(cell.actions[0].data) == [0.01, 0, 0, 0, 0, 0, 1.0]
    assert cell.actions[0].layout.dim[0].label == "ee_delta_base"
    assert holds_within(lambda: cell.status()["ready"] == "true")
    assert cell.status()["backend.tokens_kept"] == "3"


def test_what_is_missing_is_named(make_inference: Callable[..., Cell]) -> None:
    cell = make_inference("picky")
    expected = (
        "images on camera/front/image and joint states on joint_states and the "
        "end-effector pose on ee_pose"
    )
    assert holds_within(lambda: cell.status()["waiting_for"].startswith(expected))


def test_an_image_that_is_old_from_the_future_or_of_another_kind_is_never_acted_on(
    make_inference: Callable[..., Cell],
) -> None:
    cell = make_inference("instant")
    cell.send_image(age_s=0.6)
    assert holds_within(lambda: cell.status().get("dropped.old_image") == "1")
    cell.send_image(age_s=-3600.0)
    assert holds_within(lambda: cell.status().get("dropped.future_image") == "1")
    assert not cell.actions
    wrong: dict[str, Any] = {"encoding": "16UC1", "width": 9, "step": 1, "height": 0}
    for field, value in wrong.items():
        sent = len(cell.actions)
        assert cell.send_until(
            lambda: cell.status()["error_code"] == "invalid_input", **{field: value}
        ), field
        assert len(cell.actions) == sent, field
        # clocks of two machines are never quite the same
        assert cell.send_until(lambda sent=sent: len(cell.actions) > sent, age_s=-0.05)
        assert holds_within(lambda: cell.status()["error_code"] == ""), field


@pytest.mark.parametrize(
    ("old", "said"), [("ee_pose", "end-effector pose"), ("joint_state", "joint state")]
)
def test_old_proprioception_is_never_acted_on(
    make_inference: Callable[..., Cell], old: str, said: str
) -> None:
    """A dead control leaves its last pose behind; steps relative to it would never end."""
    cell = make_inference("picky", replace={'instruction = "go"': 'instruction = "the red one"'})
    states = cell.world.publisher(JointState, "joint_states")
    poses = cell.world.publisher(PoseStamped, "ee_pose")

    def send_all(age_s: float = 0.0) -> None:
        now_ns = cell.world.node.get_clock().now().nanoseconds
        ages_ns = {"joint_state": 0, "ee_pose": 0, old: int(age_s * 1e9)}
        joints = JointSample(
            names=("a",), position=np.zeros(1), stamp_ns=now_ns - ages_ns["joint_state"]
        )
        states.publish(to_joint_state(joints))
        upright = np.array([0, 0, 0, 1.0])
        pose = Pose(
            position_m=np.zeros(3), quaternion_xyzw=upright, stamp_ns=now_ns - ages_ns["ee_pose"]
        )
        poses.publish(to_pose_stamped(pose, "base"))
        time.sleep(0.02)
        cell.send_image()

    assert holds_within(lambda: send_all() is None and len(cell.actions) > 0)
    # the last of these images may still be acted on
    counts = [0]
    while len(cell.actions) > counts[-1]:
        counts.append(len(cell.actions))
        holds_within(lambda: len(cell.actions) > counts[-1], 0.5)
    sent = counts[-1]
    refused = f"dropped.old_{old}"
    assert holds_within(
        lambda: send_all(0.6) is None and f"No usable {said} for" in cell.status()["message"]
    )
    assert int(cell.status()[refused]) > 2
    assert len(cell.actions) == sent
    assert holds_within(lambda: send_all() is None and len(cell.actions) > sent)


def test_answer_that_comes_too_late_for_its_image_is_dropped_and_reported(
    make_inference: Callable[..., Cell],
) -> None:
    old, new = 'instruction = "go"', 'instruction = "go"\nmax_image_age_s = 0.2'
    cell = make_inference("slow", replace={old: new})

    def is_dropped() -> bool:
        cell.send_image()
        return holds_within(lambda: "dropped.late_action" in cell.status(), 2.0)

    assert holds_within(is_dropped), "on a busy machine an image may be too old to be looked at"
    assert "The image behind row 1 of 1 was 0." in cell.status()["message"]
    assert "max_image_age_s = 0.2 are allowed" in cell.status()["message"]
    assert cell.status()["ready"] == "false"
    assert not cell.actions


def test_deactivation_gives_up_what_a_runtime_works_on(make_inference: Callable[..., Cell]) -> None:
    cell = make_inference("served")
    cell.send_image()
    runtime = cell.inference.module.runtime
    assert holds_within(lambda: runtime.running)
    started_s = time.monotonic()
    assert cell.world.run(cell.inference.trigger_deactivate) is TransitionCallbackReturn.SUCCESS
    assert time.monotonic() - started_s < 10.0, "the request would have taken a minute"
    assert not runtime.running
    assert not cell.actions
    assert cell.status()["error_code"] == ""


def test_images_that_stop_are_an_error_and_end_the_actions(
    make_inference: Callable[..., Cell],
) -> None:
    cell = make_inference("instant")
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)
    assert holds_within(lambda: cell.status()["error_code"] == "not_ready", 3.0)
    assert len(cell.actions) == 1
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 2)
    assert holds_within(lambda: cell.status()["error_code"] == "")


def test_topic_of_a_wrong_type_is_refused_at_activation(world: Any) -> None:
    context = rclpy.Context()
    context.init()
    stranger = rclpy.create_node("stranger", namespace="pair", context=context)
    stranger.create_publisher(String, "camera/front/image", 1)
    node = world.module("inference")
    assert world.run(node.trigger_configure) is TransitionCallbackReturn.SUCCESS
    topic = "/pair/camera/front/image"
    assert holds_within(
        lambda: "std_msgs/msg/String" in dict(node.get_topic_names_and_types())[topic]
    )
    assert world.run(node.trigger_activate) is TransitionCallbackReturn.FAILURE
    assert (
        "carries std_msgs/msg/String, expected sensor_msgs/msg/Image"
        in node.status.to_message().message
    )
    stranger.destroy_node()
    context.shutdown()


def test_slow_backend_skips_to_the_newest_image(
    make_inference: Callable[..., Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = make_inference("instant")
    module = cell.inference.module
    seen: list[int] = []
    may_answer = threading.Event()
    answer = module.backend.predict

    def think(observation: Any) -> Any:
        seen.append(observation.stamp_ns)
        assert may_answer.wait(20.0)
        return answer(observation)

    monkeypatch.setattr(module.backend, "predict", think)
    cell.send_image()
    assert holds_within(lambda: len(seen) == 1)
    stamps_ns = [cell.send_image() for _ in range(5)]
    assert cell.images.wait_for_all_acked(Duration(seconds=10))
    may_answer.set()
    assert holds_within(lambda: len(seen) == 2)
    assert seen[1] == stamps_ns[-1]


def test_chunk_is_played_out_one_action_per_step_and_deactivation_silences_within_one(
    make_inference: Callable[..., Cell],
) -> None:
    cell = make_inference("chunked")
    started_s = time.monotonic()
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 5)
    assert time.monotonic() - started_s >= 4 * 0.05
    assert [round(a.data[0] * 1000) for a in cell.actions] == [0, 1, 2, 3, 4]
    assert holds_within(
        lambda: (cell.status()["chunk_row"], cell.status()["chunk_rows"]) == ("5", "5")
    )
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) > 5)
    cell.world.run(cell.inference.trigger_deactivate)
    count = len(cell.actions)
    cell.send_image()
    assert not holds_within(lambda: len(cell.actions) > count + 1, 0.3)


def test_backend_that_produces_nan_publishes_nothing_and_says_so(
    make_inference: Callable[..., Cell],
) -> None:
    cell = make_inference("nan")
    cell.send_image()
    assert holds_within(lambda: cell.status()["error_code"] == "unsafe")
    assert not cell.actions


def test_backend_that_does_not_load_leaves_the_module_unconfigured(
    world: Any, status_of: Any
) -> None:
    node = world.module("inference", replace={'backend = "instant"': 'backend = "broken"'})
    assert world.run(node.trigger_configure) is TransitionCallbackReturn.FAILURE
    told = status_of(node)
    assert (told["state"], told["error_code"]) == ("unconfigured", "checkpoint")
    assert told["message"] == "The checkpoint is cut short. Copy it again."
