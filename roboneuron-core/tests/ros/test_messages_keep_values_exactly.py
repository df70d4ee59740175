"""Conversions between contract types and ROS messages, through real serialization."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Image, JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboneuron.contract import (
    ACTION_LABEL,
    CameraCalibration,
    CameraProfile,
    Channel,
    ControlSpace,
    Frame,
    JointCommand,
    JointSample,
    Pose,
    joints_from_message,
    pose_from_message,
    to_ns,
)
from roboneuron.errors import InvalidInputError
from roboneuron.modules.inference.inputs import (
    CalibratedCamera,
)
from roboneuron.modules.perception.module import to_camera_info
from roboneuron.ros import messages
from roboneuron.ros.messages import frame_from_message

FINITE = st.floats(allow_nan=False, allow_infinity=False)
STAMP_NS = 1_700_000_000_123_456_789


def over_the_wire(message: Any) -> Any:
    return deserialize_message(serialize_message(message), type(message))


def image(height: int = 4, width: int = 6) -> np.ndarray:
    return np.arange(height * width * 3, dtype=np.uint8).reshape(height, width, 3)


def test_frame_survives_the_wire() -> None:
    frame = Frame(camera="front", image=image(), stamp_ns=STAMP_NS, frame_id="optical")
    back = frame_from_message(over_the_wire(messages.to_image(frame)), "front")
    np.testing.assert_array_equal(back.image, frame.image)
    assert (back.stamp_ns, back.frame_id) == (STAMP_NS, "optical")


def calibration() -> CameraCalibration:
    intrinsics = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
    return CameraCalibration(intrinsics=intrinsics, mount="tcp", T_mount_camera=np.eye(4))


def camera_info_of(frame: Frame) -> CameraInfo:
    assert frame.calibration is not None
    return to_camera_info(frame.calibration.intrinsics, messages.to_image(frame))


def test_intrinsics_cross_the_wire_with_pixel_centres_at_integers() -> None:
    frame = Frame(
        camera="c", image=image(), stamp_ns=STAMP_NS, frame_id="optical", calibration=calibration()
    )
    info = over_the_wire(camera_info_of(frame))
    assert (info.width, info.height, info.header.frame_id, to_ns(info.header.stamp)) == (
        6,
        4,
        "optical",
        STAMP_NS,
    )
    assert (info.k[2], info.k[5], info.k[8]) == (319.5, 239.5, 1.0)
    np.testing.assert_array_equal(
        messages.intrinsics_from_camera_info(info), calibration().intrinsics
    )


@pytest.mark.parametrize("k", [[0.0] * 9, [float("nan")] * 9])
def test_camera_info_of_an_uncalibrated_camera_is_refused(k: list[float]) -> None:
    with pytest.raises(InvalidInputError, match="no calibration"):
        messages.intrinsics_from_camera_info(CameraInfo(k=k))


def test_published_intrinsics_count_before_those_of_the_profile() -> None:
    profile = CameraProfile(
        name="c", role="primary", frame_id="f", width=8, height=8, calibration=calibration()
    )
    camera = CalibratedCamera(profile)
    wide = Frame(
        camera="c", image=image(), stamp_ns=STAMP_NS, frame_id="f", calibration=calibration()
    )
    assert camera.to_frame(messages.to_image(wide)).calibration is None, (
        "6x4 is not the profile's aspect ratio"
    )
    camera.set_info(camera_info_of(wide))
    found = camera.to_frame(messages.to_image(wide)).calibration
    np.testing.assert_array_equal(found.intrinsics, calibration().intrinsics)
    assert found.mount == "tcp"


def test_rows_with_padding_are_read_without_it() -> None:
    pixels = image()
    padded = np.zeros((4, 24), dtype=np.uint8)
    padded[:, :18] = pixels.reshape(4, 18)
    message = messages.to_image(Frame(camera="c", image=pixels, stamp_ns=1, frame_id="f"))
    message.step, message.data = 24, padded.tobytes()
    np.testing.assert_array_equal(frame_from_message(message, "c").image, pixels)


def test_bgr8_is_turned_into_rgb() -> None:
    message = messages.to_image(Frame(camera="c", image=image(), stamp_ns=1, frame_id="f"))
    message.encoding = "bgr8"
    np.testing.assert_array_equal(frame_from_message(message, "c").image, image()[:, :, ::-1])


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("encoding", "32FC1", "Image encoding '32FC1' is depth"),
        ("width", 7, "Image buffer holds 72 bytes"),
        ("height", 0, "outside 1..8192"),
        ("step", 5, "Image buffer holds"),
    ],
)
def test_damaged_image_is_refused(field: str, value: object, says: str) -> None:
    message = messages.to_image(Frame(camera="c", image=image(), stamp_ns=1, frame_id="f"))
    setattr(message, field, value)
    with pytest.raises(InvalidInputError, match=says):
        frame_from_message(message, "c")


def test_image_without_capture_time_is_refused() -> None:
    message = Image(height=1, width=1, step=3, encoding="rgb8", data=b"abc")
    with pytest.raises(InvalidInputError, match="no capture time"):
        frame_from_message(message, "c")


@pytest.mark.parametrize(
    ("height", "width", "focal_px"), [(8, 12, 200.0), (4, 6, 100.0), (4, 4, None)]
)
def test_calibration_follows_the_image_size_and_is_dropped_for_another_shape(
    height: int, width: int, focal_px: float | None
) -> None:
    intrinsics = np.array([[100.0, 0, 3], [0, 100.0, 2], [0, 0, 1]])
    known = CameraCalibration(intrinsics=intrinsics, mount="base", T_mount_camera=np.eye(4))
    profile = CameraProfile(
        name="c", role="primary", frame_id="f", width=6, height=4, calibration=known
    )
    frame = Frame(camera="c", image=image(height, width), stamp_ns=1, frame_id="f")
    got = CalibratedCamera(profile).to_frame(messages.to_image(frame)).calibration
    assert (None if got is None else got.intrinsics[0, 0]) == focal_px


@given(st.lists(FINITE, min_size=7, max_size=7))
@settings(max_examples=50)
def test_action_survives_the_wire_to_the_last_bit(values: list[float]) -> None:
    vector = np.array(values)
    message = over_the_wire(messages.to_action_message(vector))
    label, back = messages.row_from_action_message(message)
    assert label == ACTION_LABEL
    np.testing.assert_array_equal(back, vector)


def test_a_row_of_another_space_carries_its_label() -> None:
    joints = tuple(Channel(name=name, unit="rad/s") for name in "ab")
    space = ControlSpace(kind="joint_velocity", channels=joints, rate_hz=15.0)
    message = over_the_wire(messages.to_action_message(np.array([0.1, -0.2]), space))
    assert messages.row_from_action_message(message)[0] == "joint_velocity@15:a,b"
    assert [dim.size for dim in message.layout.dim] == [2]


@pytest.mark.parametrize("rate_hz", [3.0, 20.0, 1000.0 / 33.0])
def test_planned_rows_survive_the_wire_beside_the_row_that_is_due(rate_hz: float) -> None:
    rows = np.arange(21.0).reshape(3, 7)
    planned = messages.PlannedRows(rows=rows[1:], step_s=1.0 / rate_hz)
    message = over_the_wire(messages.to_action_message(rows[0], planned=planned))
    label, row = messages.row_from_action_message(message)
    back = messages.PlannedRows.from_action_message(message)
    assert label == ACTION_LABEL
    np.testing.assert_array_equal(row, rows[0])
    assert back is not None
    np.testing.assert_array_equal(back.rows, rows[1:])
    assert back.step_s == pytest.approx(1.0 / rate_hz, rel=1e-5)


def test_an_action_without_planned_rows_is_as_it_was() -> None:
    row = np.arange(7.0)
    empty = messages.PlannedRows(rows=np.zeros((0, 7)), step_s=0.05)
    message = messages.to_action_message(row)
    assert messages.to_action_message(row, planned=empty) == message
    assert messages.PlannedRows.from_action_message(message) is None


def test_joint_state_survives_the_wire() -> None:
    joints = JointSample(
        names=("a", "b"),
        position=np.array([1.5, -2.0]),
        velocity=np.array([0.1, 0.2]),
        stamp_ns=STAMP_NS,
    )
    back = joints_from_message(over_the_wire(messages.to_joint_state(joints)))
    assert back.names == joints.names
    np.testing.assert_array_equal(back.position, joints.position)
    assert back.velocity is not None
    assert back.stamp_ns == STAMP_NS


@pytest.mark.parametrize(
    ("names", "position", "velocity"),
    [(["a", "b"], [1.0], []), (["a", "a"], [1.0, 2.0], []), (["a", "b"], [1.0, 2.0], [0.1])],
)
def test_joint_state_that_does_not_match_itself_is_refused(
    names: list[str], position: list[float], velocity: list[float]
) -> None:
    with pytest.raises(InvalidInputError):
        joints_from_message(JointState(name=names, position=position, velocity=velocity))


def test_pose_survives_the_wire() -> None:
    pose = Pose(
        position_m=np.array([1.0, 2.0, 3.0]),
        quaternion_xyzw=np.array([0.0, 0.6, 0.0, 0.8]),
        stamp_ns=5,
    )
    back = pose_from_message(over_the_wire(messages.to_pose_stamped(pose, "base")))
    np.testing.assert_array_equal(back.position_m, pose.position_m)
    np.testing.assert_array_equal(back.quaternion_xyzw, pose.quaternion_xyzw)


def test_command_becomes_one_trajectory_point_and_comes_back() -> None:
    command = JointCommand(names=("a", "b"), position=np.array([0.1, 0.2]), duration_s=0.1)
    (back,) = messages.commands_from_message(over_the_wire(messages.to_joint_trajectory(command)))
    np.testing.assert_array_equal(back.position, command.position)
    assert back.duration_s == pytest.approx(0.1, abs=1e-9)  # nanoseconds on the wire


def trajectory(
    *points: tuple[float, list[float]], names: tuple[str, ...] = ("a",)
) -> JointTrajectory:
    message = JointTrajectory(joint_names=list(names))
    for seconds, positions in points:
        point = JointTrajectoryPoint(positions=positions)
        point.time_from_start.sec = int(seconds)
        point.time_from_start.nanosec = int((seconds % 1) * 1e9)
        message.points.append(point)
    return message


def test_later_points_take_the_time_since_the_point_before() -> None:
    commands = messages.commands_from_message(trajectory((1.0, [0.1]), (2.5, [0.2])))
    assert [c.duration_s for c in commands] == [1.0, 1.5]


@pytest.mark.parametrize(
    ("message", "says"),
    [
        (trajectory(), "no points"),
        (trajectory((1.0, [0.1]), names=()), "no joint names"),
        (trajectory((1.0, [0.1, 0.2])), "2 positions for 1 joints"),
        (trajectory((1.0, [float("nan")])), "non-finite"),
        (trajectory((1.0, [0.1]), (1.0, [0.2])), "not after"),
        (trajectory((0.0, [0.1])), "not after"),
    ],
)
def test_trajectory_that_cannot_be_executed_is_refused(message: JointTrajectory, says: str) -> None:
    with pytest.raises(InvalidInputError, match=says):
        messages.commands_from_message(message)
