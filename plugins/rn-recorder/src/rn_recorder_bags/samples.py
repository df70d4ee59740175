"""Numbers and pictures in the messages of a bag."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rn_recorder_runs.images import pixels_of
from rn_recorder_runs.video import load_av
from roboneuron import InvalidInputError, joints_from_message

JOINT_STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
VIDEO = "foxglove_msgs/msg/CompressedVideo"
U8 = NDArray[np.uint8]
_DECODERS = {"h264": "h264", "h265": "hevc"}
"""Decoders by `format` of a CompressedVideo. Source: Foxglove's schema of the type. VP9 and AV1
are not read: their decoders do not tell that a frame is missing.
"""
_LOSS = "Frame num gap"
_PATH = re.compile(r"([A-Za-z]\w*)|\.([A-Za-z]\w*)|\[(\d+)\]")
_LARGEST = float(np.finfo(np.float32).max)
_S = 1_000_000_000


def stamp_of(message: Any) -> int | None:
    """Stamp of a message [ns]: `header.stamp` or `timestamp`; None if its type has none."""
    header = getattr(message, "header", None)
    stamp: Any = getattr(header, "stamp", getattr(message, "timestamp", None))
    if not hasattr(stamp, "nanosec"):
        return None
    return int(stamp.sec) * _S + int(stamp.nanosec)


def field_of(message: object, path: str) -> object:
    """Field of a message by its path, such as `pose.position.x` or `data[0]`. Raises
    InvalidInputError if there is none.
    """
    found: Any = message
    end = 0
    try:
        while end < len(path):
            step = _PATH.match(path, end)
            if step is None or (step[1] is not None) != (end == 0):
                raise InvalidInputError(f"{path!r} is no path of fields.")
            end = step.end()
            found = found[int(step[3])] if step[3] else getattr(found, step[1] or step[2])
    except (AttributeError, IndexError, TypeError) as error:
        raise InvalidInputError(f"it has no field {path}") from error
    return found


def numbers_of(
    message: Any, type_name: str, names: Mapping[str, str]
) -> Iterator[tuple[int, dict[str, float]]]:
    """Yield values by name in the data set, each with the time after the message [ns] at which it
    begins to hold: 0, of a trajectory's points after the first when the one before is reached.

    Args:
        message: decoded.
        type_name: its type.
        names: as of `NumberSource.values`; joints that the message does not name are left out.

    Raises:
        InvalidInputError: the message contradicts itself, a field is missing, or a value is not
            finite as float32.
    """
    if type_name == JOINT_STATE:
        sample = joints_from_message(message)
        yield 0, _chosen(dict(zip(sample.names, sample.position.tolist(), strict=True)), names)
    elif type_name == TRAJECTORY:
        yield from _points(message, names)
    else:
        yield 0, _chosen({path: field_of(message, path) for path in names}, names)


def _points(message: Any, names: Mapping[str, str]) -> Iterator[tuple[int, dict[str, float]]]:
    joints = tuple(message.joint_names)
    after_ns = 0
    if not message.points:
        raise InvalidInputError("a trajectory has no points")
    for point in message.points:
        if len(point.positions) != len(joints) or len(set(joints)) != len(joints):
            raise InvalidInputError(
                f"a trajectory has {len(set(joints))} joints and {len(point.positions)} positions"
            )
        yield after_ns, _chosen(dict(zip(joints, point.positions, strict=True)), names)
        after_ns = int(point.time_from_start.sec) * _S + int(point.time_from_start.nanosec)


def _chosen(found: Mapping[str, object], names: Mapping[str, str]) -> dict[str, float]:
    chosen: dict[str, float] = {}
    for name, ours in names.items():
        if name not in found:
            continue
        value = found[name]
        if not isinstance(value, int | float):
            raise InvalidInputError(f"{name} is no number")
        if not abs(value) <= _LARGEST:
            raise InvalidInputError(f"{name} is not finite or too large for float32")
        chosen[ours] = float(value)
    return chosen


class Pictures:
    """Decodes the image messages of one topic in their order, uint8 (H, W, 3) RGB.

    Args:
        finds_losses: refuse video frames before which a frame is missing in the bag; takes
            milliseconds a frame.
    """

    def __init__(self, finds_losses: bool = False) -> None:
        self._finds_losses = finds_losses
        self._codec: Any = None
        self._format = ""

    def decode(self, number: int, message: Any, type_name: str) -> list[tuple[int, U8]]:
        """Pictures that are known by now, each with the number of its message; of a video those of
        messages before may be among them.

        Raises:
            InvalidInputError: it is no picture, or damaged; call `lose`.
            MissingDependencyError: PyAV is not installed.
        """
        if type_name != VIDEO:
            return [(number, pixels_of(message, type_name))]
        av = load_av()
        if self._codec is None or message.format != self._format:
            self._codec = self._open(message.format)
        packet = av.Packet(bytes(message.data))
        packet.pts = number
        if not packet.size:  # the decoder would take it for the end
            raise InvalidInputError("a video frame is empty")
        try:
            return self._frames(packet)
        except av.FFmpegError as error:
            raise InvalidInputError(
                f"a video frame, or one before it, is damaged or missing ({error.strerror})"
            ) from error

    def lose(self) -> None:
        """Note that a message is missing: what follows of a video needs a new key frame."""
        self._codec = None

    def finish(self) -> list[tuple[int, U8]]:
        """Pictures that the decoder of a video still holds."""
        return self._frames(None) if self._codec is not None else []

    def _open(self, form: str) -> Any:
        if form not in _DECODERS:
            raise InvalidInputError(
                f"a video of the format {form[:60]!r} is not read, only {', '.join(_DECODERS)}"
            )
        self._format = form
        codec = load_av().CodecContext.create(_DECODERS[form], "r")
        codec.thread_count = 1  # more threads return frames later
        codec.options = {"err_detect": "explode"}
        return codec

    def _frames(self, packet: Any) -> list[tuple[int, U8]]:
        logging = load_av().logging
        level = logging.get_level()
        # FFmpeg 8 shows instead of a missing frame of H.264 another one, and tells it so only
        logging.set_level(logging.DEBUG if self._finds_losses else level)
        try:
            with logging.Capture() as lines:
                frames = self._codec.decode(packet)
        finally:
            logging.set_level(level)
        if any(text.startswith(_LOSS) for _, _, text in lines):
            raise InvalidInputError("a video frame before it is missing")
        return [
            (int(frame.pts), frame.to_ndarray(format="rgb24"))
            for frame in frames
            if not frame.is_corrupt
        ]
