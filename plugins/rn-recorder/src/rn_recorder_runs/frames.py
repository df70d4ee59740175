"""Transforms and robot description among the recorded messages, unless another node
publishes them.
"""

from __future__ import annotations

import logging
import time

from rn_recorder_runs.channels import latched_channel, plain_channel
from rn_recorder_runs.files import Record
from rn_recorder_runs.reading import RecordDecoder
from rn_recorder_runs.recording import Recording
from rn_recorder_runs.schemas import definition
from rn_recorder_runs.settings import RecorderSettings
from rn_recorder_runs.transforms import DESCRIPTION, TF, TF_STATIC, RobotTransforms

log = logging.getLogger(__name__)
_PERIOD_NS = 30_000_000
"""Period of messages on /tf, lower than the rate of joint states by a factor of four, which
suffices for viewing.
"""
_JOINT_STATE = "sensor_msgs/msg/JointState"


class Frames:
    """Follows the joint states of the robot. Used from one thread."""

    def __init__(self, settings: RecorderSettings, recording: Recording) -> None:
        self._settings, self._recording = settings, recording
        self._robot: RobotTransforms | None = None
        self._decoder = RecordDecoder()
        self._joints_topic = f"/{settings.namespace}/joint_states"
        self._last_ns = 0

    def begin(self) -> None:
        """Add the static transforms to the latched messages; none for a robot without frames."""
        if not (self._settings.urdf or self._settings.mounts):
            return
        try:
            self._robot = RobotTransforms(self._settings.urdf, self._settings.mounts)
            self._decoder.definitions[_JOINT_STATE] = definition(_JOINT_STATE)
        except (ValueError, FileNotFoundError) as error:
            log.warning("Transforms are not recorded: %s", error)
            return
        now_ns = time.time_ns()
        channels = self._recording.latched.channels
        channels[TF], channels[TF_STATIC] = plain_channel(), latched_channel()
        if self._robot.has_fixed:
            self._recording.take(self._robot.static(now_ns))
        if self._robot.urdf:
            topic = f"/{self._settings.namespace}/{DESCRIPTION}"
            channels[topic] = latched_channel()
            self._recording.take(self._robot.description(topic, now_ns))

    def follow(self, record: Record) -> None:
        """Add the transforms of joint states; stops once another node publishes on /tf."""
        if record.topic == TF:
            self._robot = None
        if self._robot is None or record.topic != self._joints_topic or record.type != _JOINT_STATE:
            return
        if record.log_ns - self._last_ns < _PERIOD_NS:
            return
        message = self._decoder.decode(record)
        stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        moved = self._robot.moving(message.name, message.position, stamp_ns, record.log_ns)
        if moved is not None:
            self._last_ns = record.log_ns
            self._recording.take(moved)
