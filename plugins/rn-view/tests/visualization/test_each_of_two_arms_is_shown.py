"""The page shows of each arm its TCP, its trail, where it was sent, and how far its hand is
open.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import viser
from geometry_msgs.msg import PoseStamped

from rn_view.sources.measured_topics import MeasuredTopics
from rn_view.visualization.robot_model import RobotModel
from rn_view.visualization.scene import ArmScene
from roboneuron import ArmProfile, GripperProfile, Pose, RobotProfile
from roboneuron.ros.messages import to_pose_stamped

ARMS = tuple(
    ArmProfile(
        name=name,
        joints=(f"{name}_slide",),
        base_link="base",
        tcp_link=f"{name}_tcp",
        gripper=GripperProfile(joint=f"{name}_finger", closed_position=0.0, open_position=0.04),
    )
    for name in ("left", "right")
)
_SLIDE = """<link name="{0}_tcp"/><joint name="{0}_slide" type="prismatic"><parent link="base"/>
<child link="{0}_tcp"/><axis xyz="1 0 0"/><origin xyz="0 {1} 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""
URDF = f"""<robot name="pair"><link name="base"/>{_SLIDE.format("left", 0.5)}
{_SLIDE.format("right", -0.5)}</robot>"""
PAIR = RobotProfile(
    name="pair",
    urdf=URDF,
    base_link="base",
    tcp_link="left_tcp",
    arm_joints=("left_slide", "right_slide"),
    arms=ARMS,
)


class Topics:
    """Keeps who listens to what."""

    playback = None

    def __init__(self) -> None:
        self.listeners: dict[str, Callable[[Any], None]] = {}

    def now_s(self) -> float:
        return 1.0

    def config(self) -> Any:
        return type("Configuration", (), {"control": None})

    def subscribe(
        self, message_type: type, topic: str, callback: Callable[[Any], None]
    ) -> Callable[[], None]:
        self.listeners[topic] = callback
        return lambda: None


def pose(x: float) -> PoseStamped:
    at = Pose(position_m=np.array([x, 0.0, 0.3]), quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))
    return to_pose_stamped(at, "base")


@pytest.fixture
def measured() -> tuple[MeasuredTopics, Topics]:
    source: Any = Topics()
    made = MeasuredTopics(source, PAIR)
    made.open()
    return made, source


def test_each_arm_has_a_track_of_its_own(measured: tuple[MeasuredTopics, Topics]) -> None:
    found, topics = measured
    for x in (0.1, 0.2, 0.3):
        topics.listeners["left/ee_pose"](pose(x))
    topics.listeners["right/ee_pose"](pose(0.9))
    tips = {arm: track.pose for arm, track in found.tracks.items()}
    assert tips["left"] is not None
    assert tips["right"] is not None
    assert (tips["left"][0][0], tips["right"][0][0]) == (0.3, 0.9)
    assert [len(track.trail) for track in found.tracks.values()] == [3, 1]
    assert "ee_pose" not in topics.listeners, "that is the first arm again"
    found.clear()
    assert all(track.pose is None and not track.trail for track in found.tracks.values())


def test_a_command_sends_both_tcps() -> None:
    poses = RobotModel(PAIR).tcps_of({"left_slide": 0.2, "right_slide": -0.3})
    assert poses["left"][:3, 3] == pytest.approx([0.2, 0.5, 0.0])
    assert poses["right"][:3, 3] == pytest.approx([-0.3, -0.5, 0.0])


@pytest.fixture
def scene() -> Iterator[viser.SceneApi]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server.scene
    server.stop()


def test_the_scene_of_an_arm_says_which_and_how_far_it_is_open(
    scene: viser.SceneApi, measured: tuple[MeasuredTopics, Topics]
) -> None:
    found, topics = measured
    shown = {arm.name: ArmScene(scene, arm) for arm in ARMS}
    for x in (0.1, 0.2):
        topics.listeners["right/ee_pose"](pose(x))
    for arm, part in shown.items():
        part.update(found.tracks[arm], {"left_finger": 0.01, "right_finger": 0.04})
    labels = {arm: part._label.text for arm, part in shown.items() if part._label is not None}
    assert labels == {"left": "left: 25% open", "right": "right: 100% open"}
    assert (shown["left"]._tcp.visible, shown["right"]._tcp.visible) == (False, True)
    assert shown["right"]._tcp.position == pytest.approx([0.2, 0.0, 0.3])
    named = shown["right"]._label
    assert named is not None
    assert named.position == pytest.approx([0.2, 0.0, 0.42])
    assert shown["left"]._trail is None
    assert shown["right"]._trail is not None
    shown["left"].target(np.array([0.4, 0.0, 0.2]))
    assert (shown["left"]._target.visible, shown["right"]._target.visible) == (True, False)


def test_the_only_arm_needs_no_label(scene: viser.SceneApi) -> None:
    only = RobotProfile(name="arm", arm_joints=("j",)).each_arm[0]
    assert ArmScene(scene, only)._label is None
    assert ArmScene(scene, only).place == ""
