"""Pictures and joints of the cameras and arms that run now. Nothing here sends a command."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from roboneuron import (
    CameraCalibration,
    CameraProfile,
    ConfigurationError,
    Frame,
    InvalidInputError,
    JointSample,
    NotReadyError,
    PerceptionSource,
    PerceptionSpec,
    RobotProfile,
    joints_from_message,
)
from roboneuron.command import RosLink, environment
from roboneuron.feature import Config, Registry, build, topics

if TYPE_CHECKING:
    from sensor_msgs.msg import JointState

M = TypeVar("M")

PICTURE_S = 5.0
"""Longest wait for a picture."""
JOINTS_S = 2.0
STILL_RAD = 0.002
"""An arm whose joints differ by more [rad or m] before and after a picture has moved."""
_PROCESSED = ("resize", "max_rate_hz", "depth", "intrinsics")
"""Options of this package's sources that change pictures or what is told of them."""


@contextmanager
def joined() -> Iterator[RosLink]:
    """Join the ROS graph."""
    environment.prepare_environment()
    link = RosLink(f"roboneuron_cameras_{os.getpid()}")
    link.open()
    try:
        yield link
    finally:
        link.close()


class LinkTopics:
    """Implements `roboneuron.Topics` for a perception source in this process, which only
    receives.
    """

    def __init__(self, link: RosLink, namespace: str) -> None:
        self._link, self._prefix = link, f"/{namespace}/"
        self._ends: list[Callable[[], None]] = []

    def subscribe(
        self,
        topic: str,
        message_type: type[M],
        callback: Callable[[M], None],
        *,
        best_effort: bool = False,
    ) -> None:
        """See `Topics.subscribe`; the reliability is that of the publishers."""
        end = self._link.follow(message_type, self._absolute(topic), callback, latched=False)
        self._ends.append(end)

    def advertise(self, topic: str, message_type: type[M]) -> Callable[[M], None]:
        """Raise ConfigurationError: nothing is sent from here."""
        raise ConfigurationError(f"A camera asked to publish {topic!r}; this command only reads.")

    def publisher_types(self, topic: str) -> tuple[str, ...]:
        """See `Topics.publisher_types`."""
        found = self._link.node.get_publishers_info_by_topic(self._absolute(topic))
        return tuple(str(info.topic_type) for info in found)

    def now_ns(self) -> int:
        """See `Topics.now_ns`."""
        return int(self._link.node.get_clock().now().nanoseconds)

    def close(self) -> None:
        """End all subscriptions."""
        while self._ends:
            self._ends.pop()()

    def _absolute(self, topic: str) -> str:
        return topic if topic.startswith("/") else f"{self._prefix}{topic}"


@contextmanager
def opened(
    config: Config, registry: Registry, link: RosLink, camera: CameraProfile, *, is_raw: bool
) -> Iterator[Callable[[], Frame]]:
    """A configured camera; gives a function that takes a picture, captured after the call.

    Args:
        config: names the perception source and its options.
        registry: the installed plugins.
        link: access to ROS.
        camera: of the robot's profile.
        is_raw: of this package's sources, as captured: not resized, and undistorted only by the
            driver's camera_info, which then is the frame's calibration.

    Raises:
        ConfigurationError: there is no [perception], or the source refuses its options.
        RoboNeuronError: the camera cannot be opened; the function raises what the source's `read`
            does.
    """
    if config.perception is None:
        raise ConfigurationError(
            "The configuration has no [perception] section.", hint="Name the source of the camera."
        )
    spec = registry.get(PerceptionSpec, config.perception.source)
    options: Mapping[str, object] = config.options(spec.name)
    if is_raw:
        options, camera = as_captured(options, camera)
    lent = LinkTopics(link, config.namespace)
    source = cast("PerceptionSource", build(spec, options, lent, [camera]))
    try:
        source.open()
        yield lambda: _new_frame(source, lent)
    finally:
        source.close()
        lent.close()


def as_captured(
    options: Mapping[str, object], camera: CameraProfile
) -> tuple[Mapping[str, object], CameraProfile]:
    """Options and profile without processing; unchanged for sources without a table of the
    camera.
    """
    tables = options.get("cameras")
    table = tables.get(camera.name) if isinstance(tables, dict) else None
    if not isinstance(table, dict):
        return options, camera
    kept: dict[str, Any] = {key: value for key, value in table.items() if key not in _PROCESSED}
    calibration = None
    if "camera_info" in kept:
        # the mount of the profile is what is to be measured; the source asks for one
        calibration = CameraCalibration(
            intrinsics=np.eye(3), mount="base", T_mount_camera=np.eye(4)
        )
    else:
        kept.pop("distortion", None)
    return {**options, "cameras": {camera.name: kept}}, replace(camera, calibration=calibration)


def _new_frame(source: PerceptionSource, lent: LinkTopics) -> Frame:
    asked_ns, deadline_s = lent.now_ns(), time.monotonic() + PICTURE_S
    while (left_s := deadline_s - time.monotonic()) > 0:
        frame = source.read(left_s)
        if frame.stamp_ns >= asked_ns:
            return frame
    raise NotReadyError(f"No picture was captured within {PICTURE_S:g} s after it was asked for.")


class ArmJoints:
    """The measured joints of the robot that runs."""

    def __init__(self, link: RosLink, config: Config, profile: RobotProfile) -> None:
        from sensor_msgs.msg import JointState  # heavy

        self._topic = f"/{config.namespace}/{topics.JOINT_STATES}"
        self._names = profile.arm_joints
        self._changed = threading.Condition()
        self._newest: list[JointSample] = []
        self._end = link.follow(JointState, self._topic, self._take, latched=False)

    def close(self) -> None:
        """End the subscription."""
        self._end()

    def read(self) -> dict[str, float]:
        """Positions by arm joint [rad or m], measured after the call.

        Raises:
            NotReadyError: none came within JOINTS_S, or not of all joints of the arm.
        """
        with self._changed:
            self._newest.clear()
            self._changed.wait_for(lambda: bool(self._newest), JOINTS_S)
            found: dict[str, float] = {}
            for sample in self._newest:
                found = dict(zip(sample.names, sample.position.tolist(), strict=True))
        missing = [name for name in self._names if name not in found]
        if missing:
            raise NotReadyError(
                f"Nothing measures joint {missing[0]!r} on {self._topic}.",
                hint="Start the robot: `roboneuron serve` with this configuration, and its tool "
                "start_robot.",
            )
        return {name: found[name] for name in self._names}

    def _take(self, message: JointState) -> None:
        with suppress(InvalidInputError), self._changed:
            self._newest[:] = [joints_from_message(message)]
            self._changed.notify_all()


def moved(before: Mapping[str, float], after: Mapping[str, float]) -> bool:
    """True if an arm was not still between two measurements."""
    return any(abs(after[name] - value) > STILL_RAD for name, value in before.items())
