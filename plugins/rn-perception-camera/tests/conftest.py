"""A camera cell in memory: two cameras of a robot, the topics of their drivers, and messages as
drivers send them.
"""

from __future__ import annotations

import array
import io
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as Pillow
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from rn_perception_camera.options import RosCamerasOptions
from rn_perception_camera.ros_source import RosCameras
from rn_testing.fakes import MemoryTopics
from roboneuron.contract import CameraCalibration, CameraProfile

NOW_NS = 1_700_000_000_000_000_000
CHANNELS = {
    "rgb8": [0, 1, 2],
    "bgr8": [2, 1, 0],
    "rgba8": [0, 1, 2, 0],
    "bgra8": [2, 1, 0, 0],
    "mono8": [0],
}
MOUNT = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, 0.1], [0, 0, 1, 0.7], [0, 0, 0, 1]])


def profile(name: str, *, calibrated: bool = True) -> CameraProfile:
    """A camera of nominally 64x48 pixels with its principal point in the middle."""
    calibration = CameraCalibration(
        intrinsics=np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]),
        mount="base",
        T_mount_camera=MOUNT,
    )
    return CameraProfile(
        name=name,
        role="primary",
        frame_id=f"{name}_optical",
        width=64,
        height=48,
        calibration=calibration if calibrated else None,
    )


def stamp(message: Any, at_ns: int, frame_id: str = "driver_optical") -> Any:
    """Stamp a message."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(at_ns, 10**9)
    message.header.frame_id = frame_id
    return message


def raw(
    pixels: NDArray[np.uint8], at_ns: int = NOW_NS, encoding: str = "rgb8", padding: int = 0
) -> Image:
    """RGB pixels as sensor_msgs/Image of any encoding, with unused bytes at the end of each row."""
    height, width = pixels.shape[:2]
    rows = pixels[:, :, CHANNELS[encoding]].reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    data = array.array("B", np.ascontiguousarray(rows).tobytes())
    return stamp(
        Image(width=width, height=height, step=rows.shape[1], encoding=encoding, data=data), at_ns
    )


def compressed(
    pixels: NDArray[np.uint8], at_ns: int = NOW_NS, form: str = "png", mode: str = "RGB"
) -> CompressedImage:
    """RGB pixels as sensor_msgs/CompressedImage."""
    buffer = io.BytesIO()
    picture = Pillow.fromarray(pixels)
    (picture.convert("L").convert(mode) if mode == "I;16" else picture.convert(mode)).save(
        buffer, form
    )
    return stamp(CompressedImage(format=form, data=array.array("B", buffer.getvalue())), at_ns)


def info(
    width: int = 64, height: int = 48, d: tuple[float, ...] = (0.0,) * 5, model: str = "plumb_bob"
) -> CameraInfo:
    """A calibration in ROS' convention; P differs from K."""
    message = CameraInfo(width=width, height=height, distortion_model=model, d=list(d))
    message.k = [50.0, 0.0, 30.0, 0.0, 51.0, 20.0, 0.0, 0.0, 1.0]
    message.p = [40.0, 0.0, 31.0, 0.0, 0.0, 41.0, 21.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    return message


class Cell:
    """Sources over topics in memory, at a clock that the test sets."""

    def __init__(self) -> None:
        self.now_ns = NOW_NS
        self.topics = MemoryTopics(lambda: self.now_ns)
        self.opened: list[RosCameras] = []

    def source(self, *, calibrated: bool = True, **tables: dict[str, Any]) -> RosCameras:
        """An open source; one keyword with options for each camera, the topic being the camera's
        name.
        """
        options = {name: {"topic": name, **table} for name, table in tables.items()}
        config = RosCamerasOptions.model_validate({"cameras": options})
        source = RosCameras(
            config, self.topics, [profile(name, calibrated=calibrated) for name in tables]
        )
        self.opened.append(source)
        source.open()
        return source


@pytest.fixture
def cell() -> Iterator[Cell]:
    created = Cell()
    yield created
    for source in created.opened:
        source.close()


@pytest.fixture
def pixels() -> NDArray[np.uint8]:
    """uint8 (48, 64, 3), different in every channel."""
    return np.random.default_rng(1).integers(0, 256, (48, 64, 3), dtype=np.uint8)


@pytest.fixture(name="raw")
def _raw() -> Callable[..., Image]:
    return raw


@pytest.fixture(name="compressed")
def _compressed() -> Callable[..., CompressedImage]:
    return compressed


@pytest.fixture(name="info")
def _info() -> Callable[..., CameraInfo]:
    return info


@pytest.fixture(name="profile")
def _profile() -> Callable[..., CameraProfile]:
    return profile
