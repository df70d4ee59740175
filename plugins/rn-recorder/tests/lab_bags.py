"""Bags of a made-up lab, written by the library rosbags: other joint names, a camera and commands
at other rates than the joints, a gap, and a clock that jumps back.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import av
import numpy as np
from PIL import Image
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START_NS = 1_700_000_000_123_456_789
MS_NS = 1_000_000
JOINTS = ("a1", "a2", "finger")
LENGTH_MS, JOINTS_MS, CAMERA_MS, COMMANDS_MS = 4000, 20, 100, 50
GAP_MS = (2600, 3200)
"""Without pictures."""
JUMP_AT_MS, JUMP_MS = 3500, 5000
"""Since when the clock is late, and by how much."""
SILENCE_MS = (1500, 2500)
"""Without commands."""
ImageKind = Literal["raw", "jpeg", "png", "h264", "h265"]
CommandKind = Literal["trajectory", "joint_state", "array", "own type", "next_state"]
CutKind = Literal["text", "bool", "empty", "silence", "bag"]


def _typestore() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    video = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    grip = "std_msgs/Header header\nlab_msgs/Jaw[2] jaws\n"
    for text, name in (
        (video, "foxglove_msgs/msg/CompressedVideo"),
        ("float32 force\nfloat64 opening\n", "lab_msgs/msg/Jaw"),
        (grip, "lab_msgs/msg/Grip"),
    ):
        store.register(get_types_from_msg(text, name))
    return store


STORE = _typestore()


def make(name: str, /, **fields: object) -> Any:
    """A message of a type such as "std_msgs/Bool"."""
    package, _, kind = name.partition("/")
    return STORE.types[f"{package}/msg/{kind}"](**fields)


def stamp(at_ns: int) -> Any:
    """A `builtin_interfaces/Time`."""
    return make("builtin_interfaces/Time", sec=at_ns // 10**9, nanosec=at_ns % 10**9)


def header(at_ns: int) -> Any:
    """A `std_msgs/Header`."""
    return make("std_msgs/Header", stamp=stamp(at_ns), frame_id="lab")


@dataclass(frozen=True, slots=True)
class Event:
    """A message in a bag; (type, bytes) for one that is already serialized."""

    at_ns: int
    topic: str
    message: Any


def write_bag(
    path: Path, storage: str, events: Iterable[Event], compression: CompressionMode | None = None
) -> Path:
    """Write messages in this order."""
    plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for event in events:
            message = event.message
            if not isinstance(message, tuple):
                kind = message.__msgtype__
                message = kind, STORE.serialize_cdr(message, kind)
            kind, data = message
            if event.topic not in connections:
                connections[event.topic] = writer.add_connection(event.topic, kind, typestore=STORE)
            writer.write(connections[event.topic], event.at_ns, data)
    return path


def picture(number: int) -> np.ndarray:
    """Picture `number`, uint8 (48, 64, 3), which a codec does not make another."""
    ramp = np.linspace(0, 120, 64)[None, :] + (number * 37) % 130
    return np.stack([np.broadcast_to(ramp, (48, 64))] * 3, axis=-1).astype(np.uint8)


def joints(number: int) -> list[float]:
    """Measured positions, of which each bit counts."""
    return [0.1 + number / 300, -number / 7, 0.02]


def command(number: int) -> list[float]:
    """Commanded positions."""
    return [1 / 3 + number / 11, -number / 13, 0.04 + number / 1000]


_ENCODERS = {
    "h264": ("libx264", {"g": "5", "crf": "1", "sc_threshold": "0"}),
    "h265": ("libx265", {"x265-params": "keyint=5:bframes=0:scenecut=0:crf=1:log-level=none"}),
}


class _Video:
    """Encodes one frame a message, every fifth as a key frame."""

    def __init__(self, form: str) -> None:
        encoder, options = _ENCODERS[form]
        codec = av.CodecContext.create(encoder, "w")
        codec.width, codec.height, codec.pix_fmt = 64, 48, "yuv420p"
        codec.time_base, codec.framerate = Fraction(1, 10), Fraction(10)
        codec.options = {"tune": "zerolatency", **options}
        self._codec = codec

    def encode(self, number: int) -> bytes:
        frame = av.VideoFrame.from_ndarray(picture(number), format="rgb24")
        frame.pts = number
        (packet,) = self._codec.encode(frame)
        return bytes(packet)


def image_messages(kind: ImageKind, times_ns: Sequence[int]) -> list[Any]:
    """The pictures 0, 1, ... as messages."""
    video = _Video(kind) if kind in _ENCODERS else None
    messages = []
    for number, at_ns in enumerate(times_ns):
        if video is not None:
            data = np.frombuffer(video.encode(number), np.uint8)
            messages.append(
                make(
                    "foxglove_msgs/CompressedVideo",
                    timestamp=stamp(at_ns),
                    frame_id="lab",
                    data=data,
                    format=kind,
                )
            )
        elif kind == "raw":
            messages.append(raw_image(picture(number), at_ns))
        else:
            file = io.BytesIO()
            Image.fromarray(picture(number)).save(file, kind, quality=95)
            data = np.frombuffer(file.getvalue(), np.uint8)
            messages.append(
                make("sensor_msgs/CompressedImage", header=header(at_ns), format=kind, data=data)
            )
    return messages


def raw_image(pixels: np.ndarray, at_ns: int) -> Any:
    """A `sensor_msgs/Image`."""
    height, width, _ = pixels.shape
    return make(
        "sensor_msgs/Image",
        header=header(at_ns),
        height=height,
        width=width,
        encoding="rgb8",
        is_bigendian=0,
        step=3 * width,
        data=pixels.reshape(-1),
    )


def joint_state(names: Sequence[str], positions: Sequence[float], at_ns: int) -> Any:
    """A `sensor_msgs/JointState`."""
    return make(
        "sensor_msgs/JointState",
        header=header(at_ns),
        name=list(names),
        position=np.array(positions, np.float64),
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )


def trajectory(names: Sequence[str], points: Sequence[tuple[int, Sequence[float]]]) -> Any:
    """A `trajectory_msgs/JointTrajectory` of points (time from start [ns], positions)."""
    return make(
        "trajectory_msgs/JointTrajectory",
        header=header(0),
        joint_names=list(names),
        points=[
            make(
                "trajectory_msgs/JointTrajectoryPoint",
                positions=np.array(positions, np.float64),
                velocities=np.zeros(0),
                accelerations=np.zeros(0),
                effort=np.zeros(0),
                time_from_start=make(
                    "builtin_interfaces/Duration", sec=after // 10**9, nanosec=after % 10**9
                ),
            )
            for after, positions in points
        ],
    )


def command_message(kind: CommandKind, number: int, at_ns: int) -> Any:
    """Command `number`."""
    values = command(number)
    if kind == "trajectory":
        return trajectory(JOINTS[::-1], [(0, values[::-1])])
    if kind == "joint_state":
        return joint_state(JOINTS[::-1], values[::-1], at_ns)
    if kind == "own type":
        jaws = [make("lab_msgs/Jaw", force=1.0, opening=value) for value in values[:2]]
        return make("lab_msgs/Grip", header=header(at_ns), jaws=jaws)
    layout = make("std_msgs/MultiArrayLayout", dim=[], data_offset=0)
    return make("std_msgs/Float64MultiArray", layout=layout, data=np.array(values))


def mark_message(kind: CutKind, text: str) -> Any:
    """A message that begins an episode with an instruction, or ends one (none)."""
    if kind == "text":
        return make("std_msgs/String", data=text)
    if kind == "bool":
        return make("std_msgs/Bool", data=bool(text))
    return make("std_msgs/Empty", structure_needs_at_least_one_member=0)


MARKS_MS = ((350, "pick up"), (1850, ""), (2205, "put down"))


def lab_events(
    images: ImageKind = "png",
    commands: CommandKind = "trajectory",
    cut: CutKind = "bag",
    lost: Collection[int] = (),
) -> list[Event]:
    """The messages of a recording in their order; without the `lost` pictures."""
    timed: list[tuple[int, str, Any]] = []
    at = SimpleNamespace(ns=lambda ms: START_NS + ms * MS_NS)

    def told_ns(ms: int) -> int:
        return at.ns(ms if ms < JUMP_AT_MS else ms - JUMP_MS)

    for number, ms in enumerate(range(0, LENGTH_MS, JOINTS_MS)):
        timed.append((ms, "/lab/joints", joint_state(JOINTS, joints(number), told_ns(ms))))
    shown = [ms for ms in range(7, LENGTH_MS, CAMERA_MS) if not GAP_MS[0] <= ms < GAP_MS[1]]
    messages = image_messages(images, [told_ns(ms) for ms in shown])
    timed += [
        (ms, "/lab/cam", message)
        for number, (ms, message) in enumerate(zip(shown, messages, strict=True))
        if number not in lost
    ]
    for number, ms in enumerate(range(3, LENGTH_MS, COMMANDS_MS)):
        if commands != "next_state" and not SILENCE_MS[0] <= ms < SILENCE_MS[1]:
            timed.append((ms, "/lab/command", command_message(commands, number, told_ns(ms))))
    if cut in ("text", "bool", "empty"):
        timed += [(ms, "/lab/task", mark_message(cut, text)) for ms, text in MARKS_MS]
    timed.sort(key=lambda one: one[0])
    return [Event(told_ns(ms), topic, message) for ms, topic, message in timed]


def mapping_text(commands: CommandKind = "trajectory", cut: CutKind = "bag") -> str:
    """The file that says what the topics are."""
    named = '{ a2 = "elbow", a1 = "shoulder", finger = "gripper" }'
    action = {
        "array": '{ "data[1]" = "elbow", "data[0]" = "shoulder", "data[2]" = "gripper" }',
        "own type": '{ "jaws[1].opening" = "elbow", "jaws[0].opening" = "shoulder" }',
    }.get(commands, named)
    lines = ["fps = 20", 'robot = "lab_arm"', 'instruction = "wave"']
    if commands == "next_state":
        lines += ['action = "next_state"']
    lines += ["[[state]]", 'topic = "/lab/joints"', f"values = {named}"]
    lines += ["[cameras.front]", 'topic = "/lab/cam"']
    if commands != "next_state":
        lines += ["[[action]]", 'topic = "/lab/command"', f"values = {action}"]
    if cut == "silence":
        lines += ["[episodes]", "silence_s = 0.4"]
    elif cut != "bag":
        lines += ["[episodes]", 'topic = "/lab/task"']
    return "\n".join(lines) + "\n"
