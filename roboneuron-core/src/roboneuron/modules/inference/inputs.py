"""Newest inputs of a backend, passed to the predicting thread."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo, Image, JointState

from roboneuron.contract import (
    ArmProfile,
    ArmState,
    CameraCalibration,
    CameraProfile,
    Frame,
    GripperProfile,
    JointSample,
    Observation,
    Pose,
    joints_from_message,
    pose_from_message,
)
from roboneuron.errors import ConfigurationError, InvalidInputError
from roboneuron.modules import settings
from roboneuron.modules.status import StatusWriter
from roboneuron.ros import messages, topics

_IMAGE_TYPE = "sensor_msgs/msg/Image"


class CalibratedCamera:
    """Converter of a camera's images to frames.

    The mounting of the camera comes from the robot's profile. Its intrinsics come from the
    `camera_info` of that image size; until one is published, from the profile, scaled to the image.

    Used from one thread.
    """

    def __init__(self, profile: CameraProfile) -> None:
        """Args:
        profile: profile of the camera; without a calibration, frames have none.
        """
        self._profile = profile
        self._shape: tuple[int, ...] = ()
        self._calibrations: dict[tuple[int, int], CameraCalibration | None] = {}
        self._published: dict[tuple[int, int], tuple[float, ...]] = {}

    def set_info(self, message: CameraInfo) -> None:
        """Store the intrinsics for images of this size.

        Raises:
            InvalidInputError: the message contains no calibration.
        """
        size = (int(message.width), int(message.height))
        values = tuple(np.asarray(message.k).tolist())
        mounted = self._profile.calibration
        # it comes with every image, and hardly ever changes
        if mounted is None or self._published.get(size) == values:
            return
        self._calibrations[size] = replace(
            mounted, intrinsics=messages.intrinsics_from_camera_info(message)
        )
        self._published[size] = values

    def to_frame(self, message: Image) -> Frame:
        """sensor_msgs/Image -> Frame; `rgb8` shares the message's memory.

        Raises:
            InvalidInputError: the image is damaged, or of another size than the first one, for
                which the calibration is invalid.
        """
        size = (int(message.width), int(message.height))
        if size not in self._calibrations:
            self._calibrations[size] = self._profile.calibration_at(*size)
        frame = messages.frame_from_message(message, self._profile.name, self._calibrations[size])
        shape, expected = frame.image.shape, self._shape or frame.image.shape
        if shape != expected:
            raise InvalidInputError(
                f"Camera {frame.camera!r} changed its image size from {expected[1]}x{expected[0]} "
                "to "
                f"{shape[1]}x{shape[0]}; its images are not acted on.",
                hint="Restart perception and inference if that is meant.",
            )
        self._shape = shape
        return frame


class NewestInputs:
    """Stores the newest frame per role and the newest proprioception; older ones are overwritten,
    never queued.

    `wait` returns an observation when the first role has a new frame, all other inputs are present,
    and none is older than `max_age_s` or from the future.

    Images and observations are handled on the predicting thread. Joints and poses arrive on the
    executor's thread, which replaces each as a whole.

    Args:
        cameras: camera by role of the backend; the first role paces the loop.
        optional: roles that the backend can do without.
        needs_state: the backend needs joints and the pose of the TCP.
        gripper: converts a joint to the opening; None without one.
        max_age_s: maximum age of images and states [s].
        status: where refusals are counted.
        now_ns: ROS time [ns].
        take_images: waits for images for at most a time [s], and calls `on_camera_info` and
            `on_image` with the newest.
    """

    def __init__(
        self,
        *,
        cameras: Mapping[str, CameraProfile],
        optional: frozenset[str],
        needs_state: bool,
        gripper: GripperProfile | None,
        arms: Sequence[ArmProfile] = (),
        max_age_s: float,
        status: StatusWriter,
        now_ns: Callable[[], int],
        take_images: Callable[[float], None],
    ) -> None:
        self.cameras = dict(cameras)
        self.needs_state = needs_state
        self._optional = optional
        self._gripper = gripper
        self.arms = tuple(arms)
        self._arm_poses: dict[str, Pose] = {}
        self.max_age_s = max_age_s
        self._status = status
        self._now_ns = now_ns
        self._take_images = take_images
        self._frames: dict[str, Frame] = {}
        self._calibrated = {role: CalibratedCamera(camera) for role, camera in self.cameras.items()}
        self._joints: JointSample | None = None
        self._ee_pose: Pose | None = None
        self._used_ns = -1
        self._usable_s = time.monotonic()
        self._refused = "image"
        self._leading = next(iter(self.cameras), "")

    def on_image(self, role: str, message: Image) -> None:
        """Subscription callback for the camera with that role. A damaged image is counted, and the
        previous one kept until it is too old.
        """
        try:
            self._frames[role] = self._calibrated[role].to_frame(message)
        except InvalidInputError as error:
            self._status.drop("bad_image")
            self._status.set_error(error)

    def on_camera_info(self, role: str, message: CameraInfo) -> None:
        """Subscription callback for the calibration of the camera with that role."""
        try:
            self._calibrated[role].set_info(message)
        except InvalidInputError as error:
            self._status.drop("bad_camera_info")
            self._status.set_error(error)

    def on_joint_state(self, message: JointState) -> None:
        """Subscription callback."""
        try:
            self._joints = joints_from_message(message)
        except InvalidInputError as error:
            self._status.drop("bad_joint_state")
            self._status.set_error(error)

    def on_ee_pose(self, message: PoseStamped) -> None:
        """Subscription callback. A damaged pose is counted, as an image."""
        self._ee_pose = self._pose_of(message) or self._ee_pose

    def on_arm_pose(self, arm: str, message: PoseStamped) -> None:
        """Subscription callback for the TCP of one of several arms."""
        pose = self._pose_of(message)
        if pose is not None:
            self._arm_poses[arm] = pose

    def _pose_of(self, message: PoseStamped) -> Pose | None:
        try:
            return pose_from_message(message)
        except InvalidInputError as error:
            self._status.drop("bad_pose")
            self._status.set_error(error)
            return None

    def check_types(self, types: Mapping[str, list[str]], namespace: str) -> None:
        """Compare the graph's types with the contract's: DDS does not connect different types, and
        reports nothing.

        Args:
            types: types of the graph, by absolute topic.
            namespace: namespace of the robot.

        Raises:
            ConfigurationError: an image topic is published with another type.
        """
        for camera in self.cameras.values():
            topic = f"{namespace.rstrip('/')}/{topics.camera_image(camera.name)}"
            foreign = [t for t in types.get(topic, [_IMAGE_TYPE]) if t != _IMAGE_TYPE]
            if foreign:
                raise ConfigurationError(
                    f"Topic {topic} carries {foreign[0]}, expected {_IMAGE_TYPE} in rgb8."
                )

    def missing(self) -> str:
        """Inputs that have not arrived yet, as a phrase; empty if none is missing."""
        absent = [
            f"images on {topics.camera_image(self.cameras[role].name)}"
            for role in self.cameras
            if role not in self._frames and role not in self._optional
        ]
        if self.needs_state:
            if self._joints is None:
                absent.append(f"joint states on {topics.JOINT_STATES}")
            if self._ee_pose is None:
                absent.append(f"the end-effector pose on {topics.EE_POSE} (is control running?)")
        return " and ".join(absent)

    def captured_ns(self, observation: Observation) -> int:
        """Capture time of the first role's image, which paces the loop for every backend."""
        return observation.frames[self._leading].stamp_ns

    def silence_s(self) -> float:
        """Monotonic time since the last observation was returned, or since the start [s]."""
        return time.monotonic() - self._usable_s

    def unusable(self) -> str:
        """Input that prevents observations: "image", also when none comes, "joint_state" or
        "ee_pose".
        """
        frame = self._frames.get(self._leading)
        return (
            "image"
            if frame is None or self._doubt(frame.stamp_ns, self._now_ns())
            else self._refused
        )

    def wait(self, timeout_s: float) -> Observation | None:
        """Return the newest new observation, without its instruction; None after `timeout_s`."""
        end_s = time.monotonic() + timeout_s
        # first: the present inputs were checked, and a newer one may have arrived
        self._take_images(timeout_s)
        while not self._is_fresh():
            left_s = end_s - time.monotonic()
            if left_s <= 0.0:
                return None
            self._take_images(left_s)
        frames = {role: self._frames[role] for role in self.cameras if role in self._frames}
        joints, ee_pose, arm_poses = self._joints, self._ee_pose, dict(self._arm_poses)
        self._used_ns = frames[self._leading].stamp_ns
        now_ns = self._now_ns()
        for role, frame in list(frames.items()):
            doubt = self._doubt(frame.stamp_ns, now_ns)
            if doubt and role not in self._optional:
                self._refuse("image", doubt)
                return None
            if doubt:
                del frames[role]
        if self.needs_state:
            if joints is None or ee_pose is None or len(arm_poses) < len(self.arms):
                return None
            poses = (("ee_pose", pose.stamp_ns) for pose in (ee_pose, *arm_poses.values()))
            for what, stamp_ns in (("joint_state", joints.stamp_ns), *poses):
                doubt = self._doubt(stamp_ns, now_ns)
                if doubt:
                    self._refuse(what, doubt)
                    return None
        self._usable_s = time.monotonic()
        self._refused = "image"
        return Observation(
            frames=frames,
            instruction="",
            joints=joints,
            ee_pose=ee_pose,
            gripper_open=None if self._gripper is None else self._gripper.opening_in(joints),
            arms={
                arm.name: ArmState(
                    ee_pose=arm_poses[arm.name],
                    gripper_open=arm.opening_in(joints),
                )
                for arm in (self.arms if self.needs_state else ())
            },
            stamp_ns=min(frame.stamp_ns for frame in frames.values()),
        )

    def _doubt(self, stamp_ns: int, now_ns: int) -> str:
        """Word for the fault of a stamp; empty if it is valid.

        Args:
            stamp_ns: capture or measurement time of the input [ROS time, ns].
            now_ns: the present [ROS time, ns].
        """
        if stamp_ns < now_ns - int(self.max_age_s * 1e9):
            return "old"
        return "future" if stamp_ns > now_ns + int(settings.FUTURE_S * 1e9) else ""

    def _refuse(self, what: str, doubt: str) -> None:
        self._status.drop(f"{doubt}_{what}")
        self._refused = what

    def _is_fresh(self) -> bool:
        """True if every required role has a frame, and the first role a new one."""
        needed = [role for role in self.cameras if role not in self._optional]
        if any(role not in self._frames for role in needed) or self._leading not in self._frames:
            return False
        return self._frames[self._leading].stamp_ns != self._used_ns
