"""The inference module, judged by the actions it publishes and by what it reports."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64MultiArray, String

from rn_testing.waiting import holds_within
from roboneuron.contract import Frame, JointSample, Pose
from roboneuron.estop.latch import EmergencyStopLatch
from roboneuron.ros.messages import to_image, to_joint_state, to_pose_stamped

pytestmark = pytest.mark.ros
WITH_FALLBACK = {'instruction = "go"': 'instruction = "go"\nfallback = "instant"'}


class Cell:
    """Inference, and a camera that delivers when told to."""

    def __init__(
        self,
        world: Any,
        status_of: Any,
        backend: str,
        **options: Any,
    ) -> None:
        self.world, self._status_of = world, status_of
        self.actions = world.listen(Float64MultiArray, "action")
        replace = {'backend = "instant"': f'backend = "{backend}"'} | options.pop("replace", {})
        self.inference = world.start("inference", replace=replace, **options)
        self.images = world.publisher(Image, "camera/front/image")
        assert holds_within(lambda: world.node.count_publishers("/pair/action") == 1)

    def send_image(self, *, age_s: float = 0.0, **changes: Any) -> int:
        stamp_ns = self.world.node.get_clock().now().nanoseconds - int(age_s * 1e9)
        image = np.zeros((6, 8, 3), dtype=np.uint8)
        message = to_image(
            Frame(camera="front", image=image, stamp_ns=stamp_ns, frame_id="optical")
        )
        for name, value in changes.items():
            setattr(message, name, value)
        self.images.publish(message)
        return int(stamp_ns)

    def status(self) -> dict[str, str]:
        return dict(self._status_of(self.inference))

    def set(self, **moments_ns: int) -> None:
        parameters = [Parameter(name, value=value) for name, value in moments_ns.items()]
        results = self.world.run(lambda: self.inference.set_parameters(parameters))
        assert all(result.successful for result in results)

    def instruct(self, text: Any) -> Any:
        return self.world.run(
            lambda: self.inference.set_parameters([Parameter("instruction", value=text)])
        )[0]


@pytest.fixture
def build(world: Any, status_of: Any) -> Callable[..., Cell]:
    return lambda backend, **options: Cell(world, status_of, backend, **options)


def test_an_image_becomes_one_labelled_action(build: Callable[..., Cell]) -> None:
    cell = build("instant")
    assert cell.status()["ready"] == "false"
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)
    assert list(cell.actions[0].data) == [0.01, 0, 0, 0, 0, 0, 1.0]
    assert cell.actions[0].layout.dim[0].label == "ee_delta_base"
    assert holds_within(lambda: cell.status()["ready"] == "true")
    assert cell.status()["backend.tokens_kept"] == "3"


def test_what_is_missing_is_named(build: Callable[..., Cell]) -> None:
    cell = build("picky")
    expected = (
        "images on camera/front/image and joint states on joint_states and the "
        "end-effector pose on ee_pose"
    )
    assert holds_within(lambda: cell.status()["waiting_for"].startswith(expected))


def test_old_image_is_never_acted_on(build: Callable[..., Cell]) -> None:
    cell = build("instant")
    cell.send_image(age_s=0.6)
    assert holds_within(lambda: cell.status().get("dropped.old_image") == "1")
    assert not cell.actions


def test_image_from_the_future_is_never_acted_on(build: Callable[..., Cell]) -> None:
    cell = build("instant")
    cell.send_image(age_s=-3600.0)
    assert holds_within(lambda: cell.status().get("dropped.future_image") == "1")
    assert not cell.actions
    cell.send_image(age_s=-0.05)
    assert holds_within(lambda: len(cell.actions) == 1), (
        "clocks of two machines are never quite the same"
    )


@pytest.mark.parametrize(
    ("old", "said"), [("ee_pose", "end-effector pose"), ("joint_state", "joint state")]
)
def test_old_proprioception_is_never_acted_on(
    build: Callable[..., Cell], old: str, said: str
) -> None:
    """A control that died leaves its last pose behind; steps reckoned from that would never end."""
    cell = build("picky", replace={'instruction = "go"': 'instruction = "the red one"'})
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
    time.sleep(0.1)
    sent = len(cell.actions)
    refused = f"dropped.old_{old}"
    assert holds_within(
        lambda: send_all(0.6) is None and f"No usable {said} for" in cell.status()["message"], 4.0
    )
    assert int(cell.status()[refused]) > 2
    assert len(cell.actions) == sent
    assert holds_within(lambda: send_all() is None and len(cell.actions) > sent)


def test_answer_that_comes_too_late_for_its_image_is_dropped_and_reported(
    build: Callable[..., Cell],
) -> None:
    old, new = 'instruction = "go"', 'instruction = "go"\nmax_image_age_s = 0.2'
    cell = build("slow", replace={old: new})
    cell.send_image()
    assert holds_within(lambda: cell.status().get("dropped.late_action") == "1")
    assert "The image behind row 1 of 1 was 0." in cell.status()["message"]
    assert "max_image_age_s = 0.2 are allowed" in cell.status()["message"]
    assert cell.status()["ready"] == "false"
    assert not cell.actions


def test_deactivation_gives_up_what_a_runtime_works_on(build: Callable[..., Cell]) -> None:
    cell = build("served")
    cell.send_image()
    runtime = cell.inference.module.runtime
    assert holds_within(lambda: runtime.running)
    started_s = time.monotonic()
    assert cell.world.run(cell.inference.trigger_deactivate) is TransitionCallbackReturn.SUCCESS
    assert time.monotonic() - started_s < 10.0, "the request would have taken a minute"
    assert not runtime.running
    assert not cell.actions
    assert cell.status()["error_code"] == ""


def test_images_that_stop_are_an_error_and_end_the_actions(build: Callable[..., Cell]) -> None:
    cell = build("instant")
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)
    assert holds_within(lambda: cell.status()["error_code"] == "not_ready", 3.0)
    assert len(cell.actions) == 1
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 2)
    assert holds_within(lambda: cell.status()["error_code"] == "")


@pytest.mark.parametrize(
    ("field", "value"), [("encoding", "16UC1"), ("width", 9), ("step", 1), ("height", 0)]
)
def test_image_of_a_wrong_encoding_or_size_is_an_error(
    build: Callable[..., Cell], field: str, value: Any
) -> None:
    cell = build("instant")
    cell.send_image(**{field: value})
    assert holds_within(lambda: cell.status()["error_code"] == "invalid_input")
    assert not cell.actions


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
    build: Callable[..., Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = build("instant")
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


def test_chunk_is_played_out_one_action_per_step(build: Callable[..., Cell]) -> None:
    cell = build("chunked")
    started_s = time.monotonic()
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 5)
    assert time.monotonic() - started_s >= 4 * 0.05
    assert [round(a.data[0] * 1000) for a in cell.actions] == [0, 1, 2, 3, 4]
    assert holds_within(
        lambda: (cell.status()["chunk_row"], cell.status()["chunk_rows"]) == ("5", "5")
    )


def test_new_instruction_cuts_a_chunk_short_and_resets_the_backend(
    build: Callable[..., Cell],
) -> None:
    cell = build("chunked")
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)
    resets = cell.inference.module.backend.resets
    assert cell.instruct("something else").successful
    assert not holds_within(lambda: len(cell.actions) >= 5, 0.3)
    assert cell.status()["actions_for_instruction"] == "0"
    cell.send_image()
    assert holds_within(lambda: cell.inference.module.backend.resets == resets + 1)


def test_without_an_instruction_it_is_ready_and_still(build: Callable[..., Cell]) -> None:
    cell = build("instant", replace={'instruction = "go"': 'instruction = ""'})
    cell.send_image()
    assert holds_within(lambda: cell.status()["ready"] == "true")
    assert not cell.actions
    assert cell.instruct("go").successful
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)


@pytest.mark.parametrize("value", ["x" * 1001, 7])
def test_instruction_that_is_no_sentence_is_refused(build: Callable[..., Cell], value: Any) -> None:
    cell = build("instant")
    assert not cell.instruct(value).successful
    assert cell.status()["instruction"] == "go"


def test_instruction_that_cannot_be_grounded_is_an_error_without_motion(
    build: Callable[..., Cell],
) -> None:
    cell = build("picky")
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


def test_backend_that_produces_nan_publishes_nothing_and_says_so(
    build: Callable[..., Cell],
) -> None:
    cell = build("nan")
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


def test_deactivation_silences_within_a_step(build: Callable[..., Cell]) -> None:
    cell = build("chunked")
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)
    cell.world.run(cell.inference.trigger_deactivate)
    count = len(cell.actions)
    cell.send_image()
    assert not holds_within(lambda: len(cell.actions) > count + 1, 0.3)


def test_in_shadow_it_predicts_and_reports_but_publishes_nothing(
    build: Callable[..., Cell],
) -> None:
    cell = build("instant")
    cell.set(act_from_ns=2**62)
    cell.send_image()
    assert holds_within(lambda: cell.status()["ready"] == "true")
    assert cell.inference.handover.withheld[0].actions[0].tolist() == [0.01, 0, 0, 0, 0, 0, 1]
    assert not cell.actions
    assert not cell.inference.handover.sent


def test_its_turn_begins_and_ends_with_the_capture_time_of_the_image(
    build: Callable[..., Cell],
) -> None:
    cell = build("instant")
    now_ns = cell.world.node.get_clock().now().nanoseconds
    cell.set(act_from_ns=now_ns, act_until_ns=now_ns + 300_000_000)
    cell.send_image(age_s=0.2)
    assert holds_within(lambda: cell.status().get("note") == "in shadow")
    assert not cell.actions
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)
    assert holds_within(
        lambda: cell.world.node.get_clock().now().nanoseconds > now_ns + 300_000_000
    )
    cell.send_image()
    assert holds_within(lambda: cell.status().get("note") == "handed over to the successor")
    assert len(cell.actions) == 1


def test_a_chunk_ends_when_the_successor_begins(build: Callable[..., Cell]) -> None:
    cell = build("chunked")
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 2)
    cell.set(play_until_ns=1)
    assert not holds_within(lambda: len(cell.actions) > 3, 0.3)


def test_a_parameter_of_another_type_is_refused(build: Callable[..., Cell]) -> None:
    cell = build("instant")
    for name, value in (("instruction", 5), ("act_from_ns", "now")):
        answer = cell.world.run(
            lambda n=name, v=value: cell.inference.set_parameters([Parameter(n, value=v)])
        )[0]
        assert not answer.successful
        assert "type" in answer.reason


def test_a_parameter_that_its_feature_refuses_changes_nothing(build: Callable[..., Cell]) -> None:
    cell = build("instant")
    parameters = [Parameter("act_from_ns", value=5), Parameter("act_until_ns", value=-1)]
    result = cell.world.run(lambda: cell.inference.set_parameters_atomically(parameters))
    assert not result.successful
    assert result.reason == "no ROS time"
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)


def test_a_fallback_acts_while_the_policy_does_not_answer(
    build: Callable[..., Cell], request: pytest.FixtureRequest
) -> None:
    cell = build(
        "moody", replace={'instruction = "go"': 'instruction = "go"\nfallback = "instant"'}
    )
    may_answer = cell.inference.module.backend.may_answer
    request.addfinalizer(may_answer.set)
    may_answer.set()

    def newest() -> float:
        cell.send_image()
        time.sleep(0.02)
        return float(cell.actions[-1].data[0]) if cell.actions else 0.0

    assert holds_within(lambda: newest() == 0.005)
    assert cell.status()["fallback.acting"] == "moody"
    may_answer.clear()
    assert holds_within(lambda: newest() == 0.01), "the fallback acts"
    assert cell.status()["fallback.acting"] == "instant"
    assert cell.status()["fallback.reason"].startswith("no answer within 0.")
    assert cell.status()["error_code"] == ""
    assert holds_within(lambda: "instant acts in place of moody" in cell.status()["note"])
    may_answer.set()
    assert holds_within(lambda: newest() == 0.005, 15.0), "the policy acts again"
    assert holds_within(lambda: cell.status()["fallback.acting"] == "moody")


def test_a_stop_outlives_a_change_of_policies(
    build: Callable[..., Cell], request: pytest.FixtureRequest
) -> None:
    """An answer to an image of before the stop moves nothing, whoever gives it."""
    cell = build(
        "moody", replace={'instruction = "go"': 'instruction = "go"\nfallback = "instant"'}
    )
    may_answer = cell.inference.module.backend.may_answer
    request.addfinalizer(may_answer.set)
    may_answer.clear()
    cell.send_image()
    cell.world.run(lambda: cell.inference.require_start("a test"))
    may_answer.set()
    for _ in range(20):
        cell.send_image()
        time.sleep(0.02)
    assert not cell.actions
    assert cell.instruct("go").successful
    assert holds_within(lambda: cell.send_image() and len(cell.actions) > 0)


def test_what_is_started_during_a_stop_proves_that_it_sees(
    world: Any, build: Callable[..., Cell]
) -> None:
    """Else a start would wait in vain for its first action, and end by its time limit."""
    EmergencyStopLatch.in_directory(world.state_directory).press(who="a test", reason="a test")
    cell = build("instant")
    assert cell.status()["ready"] == "false"
    assert holds_within(lambda: cell.send_image() and cell.status()["ready"] == "true")
    assert not cell.actions
    assert not cell.instruct("go").successful
