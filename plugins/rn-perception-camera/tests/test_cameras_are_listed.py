"""`roboneuron robot cameras list`: each camera has a picture or a reason of its own."""

from __future__ import annotations

import argparse
import json
import threading
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow
from sensor_msgs.msg import CompressedImage, Image, JointState
from video_machine import SERIAL, make_machine

from rn_cameras import command, listing, live
from rn_perception_camera import devices
from rn_perception_camera.plugin import roboneuron_perceptions
from rn_testing.domain import free_ros_domain
from rn_testing.fakes import fake_registry, gantry_profile
from roboneuron import NotReadyError
from roboneuron.command import RosLink, environment, load_config

CONFIG = """\
[robot]
name = "gantry"
[perception]
source = "{source}"
[plugins.{source}.cameras.{camera}]
{options}
"""


def config(path, source, camera, options):
    path.write_text(CONFIG.format(source=source, camera=camera, options=options))
    return load_config(path)


class Capture:
    """A device: a webcam that opens and gives pictures, its metadata node that does not open, a
    twin that is in use, another that gives no picture.
    """

    def __init__(self, place, api):
        self.place = place

    def isOpened(self):
        return self.place in ("/dev/video0", "/dev/video3")

    def set(self, key, value):
        return True

    def get(self, key):
        return 8.0

    def grab(self):
        return self.place == "/dev/video0"

    def retrieve(self):
        return True, np.full((6, 8, 3), (10, 20, 200), dtype=np.uint8)

    def release(self):
        pass


@pytest.mark.parametrize("device", ["0", '"/dev/video0"', f'"{SERIAL}"', '"HD Webcam C270"'])
def test_devices_are_listed_with_those_that_fail(tmp_path, monkeypatch, device):
    make_machine(tmp_path)
    monkeypatch.setattr(devices, "SYSTEM", tmp_path)
    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    own = config(tmp_path / "a.toml", "video-camera", "front", f"device = {device}")
    found = {one.name: one for one in listing.device_cameras(tmp_path, [own])}
    assert list(found) == [SERIAL, "/dev/video2", "/dev/v4l/by-path/twin-2", "/dev/video10"]
    webcam = found.pop(SERIAL)
    assert (webcam.problem, webcam.size) == ("", (8, 6))
    assert "front" in webcam.about
    with Pillow.open(tmp_path / webcam.picture) as picture:
        assert picture.getpixel((0, 0)) == (200, 20, 10)
    assert all(one.problem and not one.picture for one in found.values())


def test_a_defect_of_one_camera_is_its_problem(tmp_path):
    def explode():
        raise RuntimeError("a defect")

    found = listing.look("device", "/dev/video0", "", tmp_path, explode)
    assert "a defect" in found.problem


@pytest.mark.parametrize(
    ("encoding", "kind", "metre"), [("16UC1", np.uint16, 1000), ("32FC1", np.float32, 1)]
)
def test_depth_is_shown_as_grey_near_light(encoding, kind, metre):
    depth = (np.linspace(0.5, 3.0, 12).reshape(3, 4) * metre).astype(kind)
    depth[2, 3] = 0
    message = Image(width=4, height=3, encoding=encoding, step=4 * depth.itemsize)
    message.data = depth.tobytes()
    picture = listing.to_picture(message)
    assert picture.shape == (3, 4, 3)
    near, far, hole = (int(picture[place][0]) for place in ((0, 0), (2, 2), (2, 3)))
    assert near > far > hole == 0


def yuyv() -> Image:
    """A usb_cam driver's image: grey, 8 x 6."""
    data = np.tile(np.array([126, 128], dtype=np.uint8), (6, 8))
    return Image(width=8, height=6, encoding="yuv422_yuy2", step=16, data=data.tobytes())


def depth() -> Image:
    data = np.full((6, 8), 700, dtype=np.uint16)
    return Image(width=8, height=6, encoding="16UC1", step=16, data=data.tobytes())


def jpeg() -> CompressedImage:
    _, data = cv2.imencode(".jpg", np.full((6, 8, 3), 90, dtype=np.uint8))
    return CompressedImage(format="jpeg", data=data.tobytes())


TOPICS = {
    "/usb_cam/image_raw": yuyv,
    "/usb_cam/image_raw/compressed": jpeg,
    "/depth/image": depth,
    "/zipped": jpeg,
    "/odd": lambda: Image(width=8, height=6, encoding="32SC2", step=64, data=bytes(384)),
    "/silent": None,
}


@pytest.fixture
def drivers(monkeypatch):
    """Drivers that publish all the time, in a domain of their own."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    environment.prepare_environment()
    link, end = RosLink("drivers"), threading.Event()
    link.open()
    senders = {
        topic: link.advertise(CompressedImage if make is jpeg else Image, topic)
        for topic, make in TOPICS.items()
    }
    joints = link.advertise(JointState, "/gantry/joint_states")
    names = gantry_profile().arm_joints

    def send():
        while not end.wait(0.05):
            for topic, make in TOPICS.items():
                if make is not None:
                    senders[topic](make())
            joints(JointState(name=names, position=[0.25] * len(names)))

    thread = threading.Thread(target=send)
    thread.start()
    yield
    end.set()
    thread.join()
    link.close()


@pytest.mark.ros
def test_topics_and_configured_cameras_are_listed(drivers, tmp_path, monkeypatch, capsys):
    registry = fake_registry(*roboneuron_perceptions())
    monkeypatch.setattr(command, "discover", lambda disabled=(), robot=None: registry)
    monkeypatch.setattr(devices, "SYSTEM", tmp_path)
    options = 'topic = "/usb_cam/image_raw"\nstamp = "arrival"'
    config(tmp_path / "a.toml", "ros-camera", "front", options)
    words = ["list", "--json", "--config", str(tmp_path / "a.toml"), "--out", str(tmp_path)]
    parser = argparse.ArgumentParser()
    cameras = command.Cameras()
    cameras.configure(parser)
    # the robot's other camera has no table
    assert cameras.run(parser.parse_args(words)) == 1
    found = {one["name"]: one for one in json.loads(capsys.readouterr().out)}
    good = {"front", "/usb_cam/image_raw", "/depth/image", "/zipped"}
    assert {name for name, one in found.items() if not one["problem"]} == good
    assert found.keys() - good == {"hand", "/odd", "/silent"}
    for name in ("front", "/usb_cam/image_raw"):
        with Pillow.open(Path(tmp_path, found[name]["picture"])) as picture:
            assert picture.size == (8, 6)
            assert picture.getpixel((3, 3)) == (128, 128, 128)


@pytest.mark.ros
def test_pictures_as_captured_and_joints_come_when_asked_for(drivers, tmp_path):
    registry = fake_registry(*roboneuron_perceptions())
    options = 'topic = "/usb_cam/image_raw"\nstamp = "arrival"\ndistortion = [0.1, 0.0, 0.0, 0.0]'
    options += '\nresize = { width = 4, height = 3, fit = "crop" }'
    own = config(tmp_path / "a.toml", "ros-camera", "front", options)
    profile = gantry_profile()
    with live.joined() as link, ExitStack() as stack:
        take = stack.enter_context(
            live.opened(own, registry, link, profile.cameras[0], is_raw=True)
        )
        first, second = take(), take()
        assert (first.image.shape, first.calibration) == ((6, 8, 3), None)
        assert second.stamp_ns > first.stamp_ns
        arm = live.ArmJoints(link, own, profile)
        stack.callback(arm.close)
        assert arm.read() == dict.fromkeys(profile.arm_joints, 0.25)
        other = live.ArmJoints(link, own, replace(profile, arm_joints=("elbow",)))
        stack.callback(other.close)
        with pytest.raises(NotReadyError, match="elbow"):
            other.read()


@pytest.mark.parametrize(
    ("table", "kept", "is_told"),
    [
        ({"device": 0, "intrinsics": [1, 1, 1, 1], "distortion": [0, 0, 0, 0]}, {"device"}, False),
        ({"topic": "/a", "depth": "/d", "max_rate_hz": 1.0}, {"topic"}, False),
        (
            {"topic": "/a", "camera_info": "/i", "distortion": "rectified"},
            {"topic", "camera_info", "distortion"},
            True,
        ),
    ],
)
def test_pictures_for_a_calibration_are_processed_by_the_driver_alone(table, kept, is_told):
    camera = gantry_profile().cameras[0]
    options, bare = live.as_captured({"cameras": {"front": table, "hand": {}}}, camera)
    assert options["cameras"].keys() == {"front"}
    assert options["cameras"]["front"].keys() == kept
    assert (bare.calibration is not None) == is_told
