"""Images of a data set: frames of a video by their times, and images inside of tables."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_recorder_runs.video import load_av
from roboneuron import InvalidInputError

U8 = NDArray[np.uint8]


def read_video_frames(path: Path, times_s: Sequence[float], fps: float) -> list[U8]:
    """Read the frames of a video at these times, uint8 (H, W, 3), RGB.

    Args:
        path: path of the video.
        times_s: in ascending order, since the beginning of the video [s].
        fps: frame rate of the video; a frame matches within half a period.

    Raises:
        InvalidInputError: the file or a frame is missing, or it cannot be decoded.
        MissingDependencyError: PyAV is not installed.
    """
    av = load_av()
    if not path.is_file():
        raise InvalidInputError(
            f"The video {path} is missing.", hint="Download the data set with its videos."
        )
    found: list[U8] = []
    half_s = 0.5 / fps
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            container.seek(int(times_s[0] / stream.time_base), stream=stream)
            for frame in container.decode(stream):
                while len(found) < len(times_s) and frame.time > times_s[len(found)] - half_s:
                    if frame.time > times_s[len(found)] + half_s:
                        break
                    found.append(frame.to_ndarray(format="rgb24"))
                if len(found) == len(times_s):
                    break
    except av.FFmpegError as error:
        raise InvalidInputError(f"The video {path} cannot be decoded: {error}.") from error
    if len(found) < len(times_s):
        raise InvalidInputError(
            f"The video {path} has no frame at {times_s[len(found)]:.3f} s.",
            hint="Is it complete, and is `fps` in meta/info.json right?",
        )
    return found


def decode_image(data: bytes, place: str) -> U8:
    """Decode a PNG or JPEG image to uint8 (H, W, 3), RGB; `place` names it in messages.

    Raises:
        InvalidInputError: it cannot be decoded.
        MissingDependencyError: PyAV is not installed.
    """
    av = load_av()
    try:
        with av.open(io.BytesIO(data)) as container:
            image: U8 = next(container.decode(video=0)).to_ndarray(format="rgb24")
    except (av.FFmpegError, StopIteration) as error:
        raise InvalidInputError(f"An image of {place} cannot be decoded.") from error
    return image
