"""`roboneuron robot cameras calibrate`: from a folder to the pose that look and locate read, and
what is refused; the dialogue in which pictures are taken.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import numpy as np
import pytest
from board_pictures import BOARD, SIZE, calibrated, difference, pose, views
from PIL import Image
from scipy.spatial.transform import Rotation

from rn_cameras import command
from rn_cameras.collecting import Collector
from rn_cameras.pictures import MeasuredFile, PictureFolder
from rn_testing.fakes import fake_registry
from roboneuron import ConfigurationError, Frame, InvalidInputError, NotReadyError, Pose
from roboneuron.command import load_config
from roboneuron.feature import load_profile

HANDS = {
    "eye-in-hand": pose((170, 10, 5), (0.05, 0.02, -0.04)),
    "eye-to-hand": pose((150, 30, 10), (0.9, 0.2, 0.7)),
    "corners": pose((150, 30, 10), (0.9, 0.2, 0.7)),
}
OTHER = pose((180, 0, 20), (0.5, 0.1, 0.0))
CONFIG = """\
[robot]
name = "gantry"   # the long one
[perception]
source = "video-camera"
[plugins.video-camera.cameras.front]
device = 0
[plugins.video-camera.cameras.hand]
device = "HD Webcam C270"
"""


@pytest.fixture(autouse=True)
def fakes(monkeypatch, tmp_path):
    monkeypatch.setattr(command, "discover", lambda disabled=(), robot=None: fake_registry())
    monkeypatch.chdir(tmp_path)
    Path("roboneuron.toml").write_text(CONFIG)


def joints_of(tcp):
    """Joints of the gantry: three slides, then yaw, pitch, roll."""
    angles = Rotation.from_matrix(tcp[:3, :3]).as_euler("ZYX")
    names = ("slide_x", "slide_y", "slide_z", "yaw", "pitch", "roll")
    return dict(zip(names, [*tcp[:3, 3].tolist(), *angles.tolist()], strict=True))


def fill(setup, folder=Path("shots")):
    """A folder as the dialogue leaves it, with a picture that shows no board, and no picture."""
    true, kept = HANDS[setup], PictureFolder(folder)
    joints, corners = {}, {}
    for place, picture in zip(*views(), strict=True):
        name = kept.add("view", picture)
        tcp = OTHER @ np.linalg.inv(true @ place)
        if setup == "eye-to-hand":
            tcp = true @ place @ np.linalg.inv(OTHER)
        joints[name] = joints_of(tcp)
    if setup == "corners":
        joints = {}
        board = true @ views()[0][2]
        kept.add("still", views()[1][2])
        touched = BOARD.outer_corners_m @ board[:3, :3].T + board[:3, 3]
        corners = {number: tuple(touched[number - 1].tolist()) for number in (1, 2, 4)}
    kept.note(MeasuredFile(joints=joints, corners=corners))
    kept.add("view", np.zeros((480, 640, 3), dtype=np.uint8))
    (folder / "view-damaged.png").write_bytes(b"no picture")
    return kept


def run(*words):
    parser = argparse.ArgumentParser()
    cameras = command.Cameras()
    cameras.configure(parser)
    return cameras.run(parser.parse_args(["calibrate", *words]))


@pytest.mark.parametrize(
    ("setup", "camera"),
    [
        ("eye-in-hand", "hand"),
        pytest.param("eye-to-hand", "front", marks=pytest.mark.exhaustive),
        pytest.param("corners", "front", marks=pytest.mark.exhaustive),
    ],
)
def test_the_pose_that_other_modules_load_is_the_true_one(setup, camera, capsys):
    fill(setup)
    assert run(camera, "--setup", setup, "--images", "shots") == 0
    told = capsys.readouterr().out
    assert "view-015.png" in told
    assert "view-damaged.png" in told
    config = load_config(Path("roboneuron.toml"))
    found = load_profile(fake_registry(), config.robot).camera(camera)
    assert found.calibration.mount == ("tcp" if setup == "eye-in-hand" else "base")
    assert (found.width, found.height) == SIZE
    away_m, away_deg = difference(found.calibration.T_mount_camera, HANDS[setup])
    assert away_m < 0.002
    assert away_deg < 0.5
    assert "# the long one" in Path("roboneuron.toml").read_text()


@pytest.mark.parametrize(
    ("words", "worse", "corners_m", "status", "is_written"),
    [
        ([], {}, None, 0, True),
        ([], {}, 0.002, 0, True),
        (["--dry-run"], {}, None, 0, False),
        ([], {"error_px": 1.2}, None, 1, False),
        ([], {"deviation_m": 0.006}, None, 1, False),
        ([], {"deviation_rad": 0.02}, None, 1, False),
        ([], {}, 0.006, 1, False),
    ],
    ids=["good", "touched", "dry run", "pixels", "position", "orientation", "corners"],
)
def test_only_a_good_calibration_is_written(
    monkeypatch, words, worse, corners_m, status, is_written
):
    made = calibrated(corners_m=corners_m, **worse)
    monkeypatch.setattr("rn_cameras.calibrating.calibrate", lambda *arguments: made)
    assert run("front", "--setup", "corners", "--images", "shots", *words) == status
    assert (Path("roboneuron.toml").read_text() != CONFIG) == is_written


def test_corners_of_the_command_line_are_kept_with_the_pictures():
    told = {1: (0.5, -0.1, 0.0), 2: (0.4, -0.1, 0.0), 4: (0.5, 0.1, 0.0)}
    words = [f"--corner={number}={x},{y},{z}" for number, (x, y, z) in told.items()]
    with pytest.raises(InvalidInputError, match="pictures"):
        run("front", "--setup", "corners", "--images", "shots", *words)
    assert PictureFolder(Path("shots")).measured().corners == told


@pytest.mark.parametrize("corner", ["5=0,0,0", "1=0,0", "0,0,0", "1=0,0,nan", "x=0,0,0"])
def test_a_corner_that_is_none_is_refused(corner):
    with pytest.raises(SystemExit):
        run("front", "--setup", "corners", "--corner", corner)


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["back", "--setup", "corners"], ConfigurationError),
        (["front", "--setup", "corners", "--robot", "left"], ConfigurationError),
        (["front", "--setup", "eye-in-hand", "--arm", "left"], ConfigurationError),
        (["front", "--setup", "corners", "--config", "absent.toml"], ConfigurationError),
        (["front", "--setup", "eye-in-hand", "--images", "empty"], InvalidInputError),
        (["front", "--setup", "eye-in-hand", "--columns", "2"], InvalidInputError),
        (["front", "--setup", "corners", "--corner", "1=0,0,0"], InvalidInputError),
    ],
)
def test_what_is_missing_is_named_before_anything_is_written(words, error):
    Path("empty").mkdir()
    with pytest.raises(error):
        run(*words)
    assert Path("roboneuron.toml").read_text() == CONFIG


@pytest.mark.parametrize(
    "text", ["{", '{"joints": {"a": {"b": "c"}}}', '{"corners": {"5": [0, 0, 0]}}', '{"x": 1}']
)
def test_damaged_measurements_are_refused(text):
    Path("shots").mkdir()
    Path("shots/measured.json").write_text(text)
    with pytest.raises(ConfigurationError, match=r"measured\.json"):
        PictureFolder(Path("shots")).measured()


class Arm:
    """Joints that a test sets; they move by `drift` at each reading."""

    def __init__(self):
        self.position, self.drift = 0.0, 0.0

    def read(self):
        self.position += self.drift
        return {"a": self.position}


def collector(folder, arm, answers, pictures):
    told = []
    line = iter(answers)
    shown = iter(pictures)

    def ask(question):
        answer = next(line)
        return answer() or "" if callable(answer) else answer

    def take():
        picture = next(shown)
        if isinstance(picture, Exception):
            raise picture
        return Frame(camera="front", image=picture, stamp_ns=1, frame_id="f")

    return Collector(folder, BOARD, take, arm, ask, told.append), told


def forward(joints):
    return Pose(position_m=np.array([joints["a"], 0, 0]), quaternion_xyzw=np.array([0, 0, 0, 1.0]))


def test_only_pictures_of_the_board_by_a_still_arm_are_kept():
    arm, folder = Arm(), PictureFolder(Path("new"))
    good, blank = views()[1][0], np.zeros((480, 640, 3), dtype=np.uint8)
    moves = itertools.cycle([lambda: setattr(arm, "drift", 0.1), lambda: setattr(arm, "drift", 0)])
    answers = ["", "", next(moves), next(moves), "q"]
    pictures = [blank, NotReadyError("late"), good, good]
    made, told = collector(folder, arm, answers, pictures)
    made.collect("eye-in-hand", forward)
    assert folder.names("") == ["view-001.png"]
    assert folder.measured().joints == {"view-001.png": {"a": arm.position}}
    assert len([line for line in told if "not kept" in line]) == 3
    assert np.array_equal(folder.read("view-001.png"), good)


def test_corners_are_touched_after_the_pictures():
    arm, folder = Arm(), PictureFolder(Path("new"))
    arm.drift = 0.25
    good = views()[1][0]
    made, _ = collector(folder, arm, ["", "q", "", "q", "", "", ""], [good, good])
    made.collect("corners", forward)
    assert folder.names("") == ["still-001.png", "view-001.png"]
    assert folder.measured().corners == {1: (0.25, 0, 0), 2: (0.5, 0, 0), 3: (0.75, 0, 0)}
    assert folder.measured().joints == {}


def test_a_picture_put_in_by_hand_keeps_its_name(tmp_path):
    folder = PictureFolder(tmp_path)
    Image.fromarray(np.zeros((4, 4, 3), dtype=np.uint8)).save(tmp_path / "view-002.png")
    assert folder.add("view", np.ones((4, 4, 3), dtype=np.uint8)) == "view-003.png"
