"""A file shows the robot and says what its topics are, wherever it is opened."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message

from rn_controller_urdf.controller import UrdfController
from rn_recorder_runs.channels import describe_channel
from rn_recorder_runs.files import LATCHED, Record, copy_records
from rn_recorder_runs.node import RecorderWorker
from rn_recorder_runs.settings import RecorderSettings, RulesSettings
from rn_recorder_runs.transforms import CameraMount, RobotTransforms
from rn_robot_fr3.profile import profile
from roboneuron import EE_DELTA, JointSample, matrix_from_quaternion
from roboneuron.ros.messages import to_action_message, to_joint_state

POSTURES = ((0.1, -0.4, 0.3, -2.0, 0.2, 1.7, 0.6), (-1.2, 0.5, -0.7, -1.1, 1.4, 2.9, -0.3))
MOUNT = CameraMount(
    parent="base", frame_id="eye", position_m=(1.0, 2.0, 3.0), quaternion_xyzw=(0.0, 0.0, 0.0, 1.0)
)
RULES = RulesSettings(
    ring_s=30.0, after_s=1.0, part_bytes=10**8, part_s=300.0, quota_bytes=10**9, min_free_bytes=0
)


def record_fr3(tmp_path: Path, foreign: Sequence[Record] = ()) -> Path:
    """A recording of an FR3 in two postures, with two actions; `foreign` comes first."""
    settings = RecorderSettings(
        namespace="fr3",
        state_directory=tmp_path,
        directory=tmp_path / "runs",
        topics=("*",),
        exclude=(),
        images="lossless",
        jpeg_quality=90,
        rules=RULES,
        about={},
        urdf=profile().urdf,
        mounts=(MOUNT,),
    )
    process = RecorderWorker(settings, lambda line: None)
    process.recording.store.make()
    process._frames.begin()
    process._orders.append({"do": "start", "number": 1, "name": "demo", "facts": {}})
    process._turn()
    for topic in ("/fr3/action", "/fr3/joint_states"):
        process.describe(topic, describe_channel([publisher()]))
    for record in foreign:
        process.put(record)
    for number, posture in enumerate(POSTURES):
        at_ns = time.time_ns() + number * 10**8
        joints = JointSample(names=profile().arm_joints, position=np.array(posture), stamp_ns=at_ns)
        message = bytes(serialize_message(to_joint_state(joints)))
        process.put(
            Record(
                "/fr3/joint_states", "sensor_msgs/msg/JointState", at_ns, at_ns, number + 1, message
            )
        )
        action = bytes(serialize_message(to_action_message(np.full(7, 0.1 * number))))
        process.put(
            Record(
                "/fr3/action", "std_msgs/msg/Float64MultiArray", at_ns, at_ns, number + 1, action
            )
        )
    process._turn()
    process.recording.close()
    return next(run for run in process.recording.store.runs() if run.kind == "recording").files[0]


def publisher(**changes: object) -> SimpleNamespace:
    qos = QoSProfile(**{"depth": 1, "reliability": ReliabilityPolicy.RELIABLE, **changes})  # type: ignore[arg-type]
    return SimpleNamespace(qos_profile=qos, topic_type_hash="RIHS01_00")


def messages(path: Path) -> Iterator[tuple[str, dict[str, str], object]]:
    """Topic, channel metadata and message of everything, by MCAP's own reader."""
    with path.open("rb") as file:
        for _, channel, _, decoded in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            yield channel.topic, channel.metadata, decoded


def pose_in(transforms: Sequence[object], base: str, tip: str) -> np.ndarray:
    """Compose what tf messages say, from tip to base; (4, 4)."""
    by_child = {transform.child_frame_id: transform for transform in transforms}  # type: ignore[attr-defined]
    pose = np.eye(4)
    while tip != base:
        found = by_child[tip]
        place, turn = found.transform.translation, found.transform.rotation
        step = np.eye(4)
        step[:3, :3] = matrix_from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w]))
        step[:3, 3] = place.x, place.y, place.z
        pose, tip = step @ pose, found.header.frame_id
    return pose


def test_the_transforms_of_a_file_are_those_of_the_robot(tmp_path: Path) -> None:
    """Composed from what the file holds they give the TCP that the controller computes."""
    found = list(messages(record_fr3(tmp_path)))
    static = [t for topic, _, message in found if topic == "/tf_static" for t in message.transforms]  # type: ignore[attr-defined]
    moving = [message.transforms for topic, _, message in found if topic == "/tf"]  # type: ignore[attr-defined]
    controller = UrdfController(None, profile())
    controller.load()
    assert len(moving) == len(POSTURES)
    for posture, transforms in zip(POSTURES, moving, strict=True):
        expected = controller.forward(
            JointSample(names=profile().arm_joints, position=np.array(posture), stamp_ns=1)
        )
        pose = pose_in([*static, *transforms], profile().base_link, profile().tcp_link)
        np.testing.assert_allclose(pose[:3, 3], expected.position_m, atol=1e-9)
        np.testing.assert_allclose(
            pose[:3, :3], matrix_from_quaternion(expected.quaternion_xyzw), atol=1e-9
        )
    assert [t.child_frame_id for t in static].count("eye") == 1
    (text,) = [message.data for topic, _, message in found if topic == "/fr3/robot_description"]  # type: ignore[attr-defined]
    assert text == profile().urdf


def test_channels_say_what_their_publishers_offer_and_what_values_are(tmp_path: Path) -> None:
    path = record_fr3(tmp_path)
    copy = tmp_path / "copy.mcap"
    copy_records([path], copy, {})
    for file in (path, copy):
        channels = {topic: metadata for topic, metadata, _ in messages(file)}
        (offered,) = yaml.safe_load(channels["/tf_static"]["offered_qos_profiles"])
        assert (offered["durability"], offered["reliability"]) == ("transient_local", "reliable")
        (offered,) = yaml.safe_load(channels["/fr3/joint_states"]["offered_qos_profiles"])
        assert (offered["history"], offered["depth"], offered["durability"]) == (
            "keep_last",
            1,
            "volatile",
        )
        assert set(offered["deadline"]) == {"sec", "nsec"}
        assert channels["/fr3/joint_states"]["topic_type_hash"] == "RIHS01_00"
        fields = channels["/fr3/action"]["roboneuron.fields"]
        assert fields == " ".join(f"data[{at}]={name}" for at, name in enumerate(EE_DELTA.keys))


def test_the_library_rosbags_reads_transforms_and_quality_of_service(tmp_path: Path) -> None:
    highlevel = pytest.importorskip("rosbags.highlevel", reason="pip install rosbags")
    with highlevel.AnyReader([record_fr3(tmp_path)]) as reader:
        (connection,) = [c for c in reader.connections if c.topic == "/tf_static"]
        _, _, data = next(reader.messages([connection]))
        assert reader.deserialize(data, connection.msgtype).transforms[0].child_frame_id
        (offered,) = connection.ext.offered_qos_profiles
        assert offered.durability.name == "TRANSIENT_LOCAL"


def test_who_publishes_transforms_himself_is_not_doubled(tmp_path: Path) -> None:
    own = RobotTransforms("", (MOUNT,)).static(time.time_ns())
    foreign = Record("/tf", own.type, own.log_ns, own.publish_ns, 1, own.data)
    found = [topic for topic, _, _ in messages(record_fr3(tmp_path, [foreign]))]
    assert found.count("/tf") == 1


def test_only_what_all_publishers_keep_is_latched() -> None:
    keeps = {"durability": DurabilityPolicy.TRANSIENT_LOCAL}
    assert LATCHED in describe_channel([publisher(**keeps), publisher(**keeps)])
    mixed = describe_channel([publisher(**keeps), publisher()])
    assert LATCHED not in mixed
    assert [one["durability"] for one in yaml.safe_load(mixed["offered_qos_profiles"])] == [
        "transient_local",
        "volatile",
    ]
