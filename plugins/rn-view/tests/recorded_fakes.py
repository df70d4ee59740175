"""A recorded run of a made-up robot: two seconds in which everything a page shows changes at known
times.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64MultiArray

from rn_recorder_runs.files import Record, RunFile
from rn_recorder_runs.images import to_jpeg, to_string

BEGIN_NS = 1_700_000_000_000_000_000
LENGTH_S, RATE_HZ = 2.0, 50
CONFIG = {
    "robot": {"name": "gantry"},
    "inference": {"backend": "instant"},
    "control": {"controller": "gantry"},
}
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


def shade(number: int) -> int:
    """Grey level of picture `number`."""
    return 40 + number


class Tape:
    """Writes the run's files."""

    def __init__(self, folder: Path) -> None:
        about = {"robot": "gantry", "namespace": "gantry", "config": json.dumps(CONFIG)}
        self.files = [folder / "part-0001.mcap", folder / "part-0002.mcap"]
        self._parts = [RunFile(path, about) for path in self.files]
        self._counts: dict[str, int] = {}

    def add(self, topic: str, type_name: str, at_s: float, data: bytes) -> None:
        """Add a message to the part of its second."""
        self._counts[topic] = self._counts.get(topic, 0) + 1
        at_ns = BEGIN_NS + round(at_s * 1e9)
        self._parts[int(at_s >= 1.0)].write(
            Record(topic, type_name, at_ns, at_ns, self._counts[topic], data)
        )

    def send(self, topic: str, message: Any, at_s: float) -> None:
        """Add a ROS message."""
        package, kind = type(message).__module__.split(".")[:2]
        self.add(
            topic,
            f"{package}/{kind}/{type(message).__name__}",
            at_s,
            bytes(serialize_message(message)),
        )

    def tell(self, topic: str, at_s: float, **facts: Any) -> None:
        """Add a line of the server or the audit."""
        facts = {
            "at_ns": BEGIN_NS + round(at_s * 1e9),
            "time_ns": BEGIN_NS + round(at_s * 1e9),
            **facts,
        }
        self.add(topic, "std_msgs/msg/String", at_s, to_string(json.dumps(facts)))

    def finish(self, *, whole: bool = True) -> list[Path]:
        """Close and return the files; the last one has no index if not `whole`."""
        self._parts[0].finish()
        if whole:
            self._parts[1].finish()
        else:
            self._parts[1].flush()
            self._parts[1].abandon()
        return self.files


def record(folder: Path, *, whole: bool = True) -> list[Path]:
    """Record the run: joints and TCP at 50 Hz, actions and pictures at 10 Hz, and what happened."""
    tape = Tape(folder)
    for step in range(round(LENGTH_S * RATE_HZ) + 1):
        at_s = step / RATE_HZ
        names = ["slide_x", "slide_y", "slide_z", "hinge_x", "hinge_y", "hinge_z", "finger"]
        joints = JointState(name=names, position=[0.1 * at_s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.02])
        tape.send("/gantry/joint_states", joints, at_s)
        pose = PoseStamped()
        pose.pose.position.x, pose.pose.orientation.w = 0.1 * at_s, 1.0
        tape.send("/gantry/ee_pose", pose, at_s)
        if step % 5 == 0:
            number = step // 5
            action = Float64MultiArray(data=[0.001 * number, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
            tape.send("/gantry/action", action, at_s)
            tape.send("/gantry/camera/front/image", picture(number), at_s)
            encoded = to_jpeg(bytes(serialize_message(picture(number))), 90)
            assert encoded is not None
            tape.add("/gantry/camera/hand/image/compressed", COMPRESSED, at_s, encoded)
        if step % 10 == 0:
            tape.send("/diagnostics", report(rate_hz=10.0 + at_s, note=f"at {at_s:.1f}"), at_s)
        if step == 10:
            facts = {
                "tool": "start_inference",
                "arguments": {"instruction": "push"},
                "error": "",
                "took_ms": 150.0,
            }
            tape.tell("/roboneuron/events", at_s, what="call", who="agent", **facts)
            tape.tell("/gantry/predictions", at_s, instruction="push")
        if step == 20:
            tape.tell(
                "/roboneuron/events",
                at_s,
                what="call",
                tool="get_status",
                arguments={},
                error="",
                took_ms=1.0,
            )
        if step == 60:
            tape.tell("/gantry/predictions", at_s, instruction="pull")
            tape.tell(
                "/roboneuron/audit",
                at_s,
                verdict="latched",
                who="ann",
                tool="emergency_stop",
                reason="too fast",
            )
            tape.tell(
                "/roboneuron/events",
                at_s,
                what="health",
                module="inference",
                before="ok",
                health="failing",
            )
        if step == 80:
            tape.tell(
                "/roboneuron/audit", at_s, verdict="reset", who="ann", tool="reset_emergency_stop"
            )
    return tape.finish(whole=whole)


def picture(number: int) -> Image:
    """Picture `number`, of one grey level; large enough to stay on disk."""
    message = Image(width=160, height=120, step=480, encoding="rgb8")
    message.data = np.full(160 * 120 * 3, shade(number), dtype=np.uint8).tobytes()
    message.header.stamp.sec = number
    return message


def report(*, rate_hz: float, note: str) -> DiagnosticArray:
    """A report of inference."""
    values = {"state": "active", "ready": "true", "rate_hz": f"{rate_hz:g}", "note": note}
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticArray(
        status=[DiagnosticStatus(name="/gantry/inference", hardware_id="123", values=pairs)]
    )
