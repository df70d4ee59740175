"""Video files through OpenCV, and devices played by a fake `cv2.VideoCapture` that can be
unplugged.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from rn_perception_camera import grabber
from rn_perception_camera.options import VideoCamerasOptions
from rn_perception_camera.video_source import VideoCameras
from rn_testing.fakes import MemoryTopics
from rn_testing.waiting import wait_until
from roboneuron.contract import CameraProfile, Frame
from roboneuron.errors import ConfigurationError, NotReadyError, StateError


class Bus:
    """The devices of a machine: which are plugged in, how they are set, and who holds them open."""

    def __init__(self) -> None:
        self.plugged = threading.Event()
        self.plugged.set()
        self.sizes = {(64, 48), (32, 24)}
        self.opened = 0
        self.held = 0
        self.shade = 0

    def capture(self, device: object, api: int) -> FakeCapture:
        assert api == cv2.CAP_V4L2
        return FakeCapture(self)


class FakeCapture:
    """A 100 Hz camera; what it does not offer it ignores, as V4L2 devices do."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._size = (64, 48)
        self._wanted = [64, 48]
        self._open = bus.plugged.is_set()
        bus.opened += self._open
        bus.held += self._open

    def isOpened(self) -> bool:
        return self._open

    def set(self, prop: int, value: float) -> bool:
        if prop in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT):
            self._wanted[prop == cv2.CAP_PROP_FRAME_HEIGHT] = int(value)
            if tuple(self._wanted) in self._bus.sizes:
                self._size = (self._wanted[0], self._wanted[1])
        return True

    def get(self, prop: int) -> float:
        return float(self._size[prop == cv2.CAP_PROP_FRAME_HEIGHT])

    def grab(self) -> bool:
        time.sleep(0.01)
        return self._bus.plugged.is_set()

    def retrieve(self) -> tuple[bool, Any]:
        self._bus.shade += 1
        blue_green_red = np.empty((self._size[1], self._size[0], 3), dtype=np.uint8)
        blue_green_red[:] = (10, 20, 200)
        return True, blue_green_red

    def release(self) -> None:
        self._bus.held -= self._open
        self._open = False


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Bus:
    """Devices instead of those of this machine; retried quickly."""
    made = Bus()
    monkeypatch.setattr(cv2, "VideoCapture", made.capture)
    monkeypatch.setattr(grabber, "FIRST_RETRY_S", 0.02)
    monkeypatch.setattr(grabber, "LAST_RETRY_S", 0.04)
    return made


@pytest.fixture
def build(profile: Any) -> Iterator[Callable[..., VideoCameras]]:
    """Makes sources that are closed in the end: one keyword with options for each camera."""
    made: list[VideoCameras] = []

    def make(calibrated: bool = True, **tables: dict[str, Any]) -> VideoCameras:
        config = VideoCamerasOptions.model_validate({"cameras": tables})
        cameras: list[CameraProfile] = [profile(name, calibrated=calibrated) for name in tables]
        made.append(VideoCameras(config, MemoryTopics(), cameras))
        return made[-1]

    yield make
    for source in made:
        source.close()


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """Six pictures of 64x48 at 50 Hz, red growing from 0 to 250, green 100, blue 30."""
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50.0, (64, 48))
    for red in range(0, 300, 50):
        writer.write(np.full((48, 64, 3), (30, 100, red), dtype=np.uint8))
    writer.release()
    return path


def read_until(
    source: VideoCameras, condition: Callable[[Exception], bool], limit_s: float = 10.0
) -> None:
    """Read until an error that meets the condition."""
    deadline_s = time.monotonic() + limit_s
    while True:
        assert time.monotonic() < deadline_s
        try:
            source.read(0.05)
        except (NotReadyError, StateError) as error:
            if condition(error):
                return


def test_film_plays_at_its_pace_in_its_colours_and_then_ends(build: Any, film: Path) -> None:
    source = build(front={"path": str(film)})
    began_s = time.monotonic()
    source.open()
    frames: list[Frame] = [source.read(5.0)]
    read_until(source, lambda error: "has ended" in str(error) and "loop = true" in str(error))
    assert time.monotonic() - began_s >= 0.1  # five times 20 ms between six pictures
    red, green, blue = frames[0].image.reshape(-1, 3).mean(axis=0)
    assert (green, blue) == pytest.approx((100, 30), abs=8)  # MJPG
    assert red <= 250
    assert abs(frames[0].stamp_ns - time.time_ns()) < 60e9
    assert frames[0].frame_id == "front_optical"


def test_film_in_a_loop_goes_on(build: Any, film: Path) -> None:
    source = build(front={"path": str(film), "loop": True, "fps": 200.0})
    source.open()
    stamps = [source.read(2.0).stamp_ns for _ in range(15)]
    assert stamps == sorted(set(stamps))


def test_slow_pace_is_kept(build: Any, film: Path) -> None:
    source = build(front={"path": str(film), "fps": 20.0})
    began_ns = time.time_ns()
    source.open()
    stamps = [source.read(5.0).stamp_ns for _ in range(4)]
    assert stamps[-1] - began_ns >= 150e6


def test_unplugged_camera_is_told_and_comes_back(build: Any, bus: Bus) -> None:
    source = build(front={"device": 7})
    source.open()
    assert source.read(2.0).image[0, 0].tolist() == [200, 20, 10]  # RGB
    bus.plugged.clear()
    read_until(source, lambda error: "Plug it in" in str(error))
    assert bus.held == 0
    bus.plugged.set()
    wait_until(lambda: bus.opened >= 2, 10.0)
    assert source.read(5.0).camera == "front"
    source.close()
    assert bus.held == 0


def test_two_cameras_take_turns(build: Any, bus: Bus) -> None:
    source = build(front={"device": 7}, hand={"device": 8})
    source.open()
    assert {source.read(2.0).camera for _ in range(4)} == {"front", "hand"}
    assert bus.held == 2


def test_absent_device_is_refused_with_those_present(build: Any, bus: Bus) -> None:
    bus.plugged.clear()
    source = build(front={"device": "/dev/v4l/by-id/usb-none"})
    with pytest.raises(
        NotReadyError,
        match=r"no camera /dev/v4l/by-id/usb-none; V4L2 devices present: .*Plug it in",
    ):
        source.open()
    with pytest.raises(StateError):
        source.read(0.01)
    bus.plugged.set()
    source.open()
    assert source.read(2.0).camera == "front"


def test_busy_device_is_told_from_an_absent_one(build: Any, bus: Bus, tmp_path: Path) -> None:
    bus.plugged.clear()
    (tmp_path / "video0").touch()
    with pytest.raises(NotReadyError, match=r"cannot be opened\. End the program that uses it"):
        build(front={"device": str(tmp_path / "video0")}).open()


def test_camera_that_opens_is_released_when_another_does_not(
    build: Any, bus: Bus, tmp_path: Path
) -> None:
    source = build(front={"device": 7}, hand={"path": str(tmp_path / "none.mp4")})
    with pytest.raises(ConfigurationError, match="no video file"):
        source.open()
    assert (bus.opened, bus.held) == (1, 0)


def test_size_that_the_device_lacks_is_refused(build: Any, bus: Bus) -> None:
    source = build(front={"device": 7, "size": (32, 24)})
    source.open()
    assert source.read(2.0).image.shape == (24, 32, 3)
    with pytest.raises(ConfigurationError, match="asked for 99x48 and gives 64x48"):
        build(front={"device": 7, "size": (99, 48)}).open()


def test_file_that_is_no_video_is_refused(build: Any, tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no film")
    with pytest.raises(ConfigurationError, match="no video that OpenCV can read"):
        build(front={"path": str(tmp_path / "text.mp4")}).open()


def test_intrinsics_of_the_options_calibrate_and_undistort(build: Any, bus: Bus) -> None:
    table = {
        "device": 7,
        "intrinsics": (50.0, 51.0, 30.0, 20.0),
        "distortion": (-0.5, 0.0, 0.0, 0.0),
    }
    source = build(front={**table, "resize": {"width": 32, "height": 24, "fit": "crop"}})
    source.open()
    frame = source.read(2.0)
    np.testing.assert_allclose(
        frame.calibration.intrinsics, [[25, 0, 15.25], [0, 25.5, 10.25], [0, 0, 1]]
    )
    with pytest.raises(ConfigurationError, match="does not tell where it is mounted"):
        build(calibrated=False, front=table).open()


def test_max_rate_bounds_a_fast_camera(build: Any, bus: Bus) -> None:
    source = build(front={"device": 7, "max_rate_hz": 20.0})
    source.open()
    began_s = time.monotonic()
    for _ in range(4):
        source.read(2.0)
    assert time.monotonic() - began_s >= 0.15


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_failed_thread_is_reported_and_has_released_the_camera(
    build: Any, bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    def explode(self: FakeCapture) -> tuple[bool, Any]:
        raise RuntimeError("a defect")

    monkeypatch.setattr(FakeCapture, "retrieve", explode)
    source = build(front={"device": 7})
    source.open()
    read_until(source, lambda error: "failed" in str(error) and "module's log" in str(error))
    assert bus.held == 0


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, "either device or path"),
        ({"device": 0, "path": "a.mp4"}, "either device or path"),
        ({"device": -1}, "expected 0 or more"),
        ({"device": 0, "loop": True}, "loop is for files"),
        ({"path": "a.mp4", "size": (64, 48)}, "size and fourcc are for devices"),
        ({"device": 0, "distortion": (0.1, 0.0, 0.0)}, "3 values, expected 4, 5 or 8"),
        ({"device": 0, "distortion": (0.1, 0.0, 0.0, float("inf"))}, "must be finite"),
        ({"device": 0, "intrinsics": (0.0, 1.0, 1.0, 1.0)}, "focal lengths"),
        ({"device": 0, "fourcc": "MJPEG"}, "fourcc"),
    ],
)
def test_options_that_contradict_are_refused(table: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        VideoCamerasOptions.model_validate({"cameras": {"front": table}})
