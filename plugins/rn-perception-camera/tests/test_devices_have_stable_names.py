"""V4L2 devices by number, path, link and card name, in folders made like those of Linux."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
from video_machine import PORT, SERIAL, make_machine

from rn_perception_camera import devices
from rn_perception_camera.capture import open_capture
from rn_perception_camera.devices import node_of, video_devices
from rn_perception_camera.options import VideoCameraOptions
from roboneuron import ConfigurationError, NotReadyError


@pytest.fixture
def machine(tmp_path, monkeypatch):
    make_machine(tmp_path)
    monkeypatch.setattr(devices, "SYSTEM", tmp_path)


def test_each_device_has_its_most_stable_name(machine):
    assert [(one.node, one.name) for one in video_devices()] == [
        ("/dev/video0", SERIAL),
        ("/dev/video1", "/dev/video1"),
        ("/dev/video2", "/dev/video2"),
        ("/dev/video3", "/dev/v4l/by-path/twin-2"),
        ("/dev/video10", "/dev/video10"),
    ]
    first, second, third, *_ = video_devices()
    assert first.links == (SERIAL, PORT)
    assert first.unit == second.unit != third.unit


@pytest.mark.parametrize(
    ("device", "node"),
    [
        (2, 2),
        ("/dev/video3", "/dev/video3"),
        (SERIAL, SERIAL),
        (PORT, PORT),
        ("HD Webcam C270", "/dev/video0"),
        ("Grabber", "/dev/video10"),
    ],
)
def test_opencv_opens_the_node_of_every_kind_of_name(machine, monkeypatch, device, node):
    asked = []

    class Absent:
        def isOpened(self):
            return False

        def release(self):
            asked.append("released")

    def capture(place, api):
        asked.append(place)
        return Absent()

    monkeypatch.setattr(cv2, "VideoCapture", capture)
    with pytest.raises(NotReadyError):
        open_capture(VideoCameraOptions(device=device))
    assert asked == [node, "released"]


def test_a_card_name_of_two_cameras_is_refused_with_the_paths(machine):
    with pytest.raises(ConfigurationError) as refused:
        node_of("Twin")
    assert "/dev/v4l/by-path/twin-2" in refused.value.hint
    assert "/dev/video2" in refused.value.hint


def test_an_absent_card_name_is_told_with_those_present(machine):
    with pytest.raises(NotReadyError, match="Grabber"):
        node_of("C920")


def test_a_machine_without_cameras_has_none(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(devices, "SYSTEM", tmp_path)
    assert video_devices() == ()
