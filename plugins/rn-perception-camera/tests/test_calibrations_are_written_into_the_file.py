"""A calibration is written into a configuration of any layout: its comments stay, and core and
source read the values back.
"""

from __future__ import annotations

import pytest
from board_pictures import DISTORTION, MATRIX, MOUNTED, SIZE, calibrated

from rn_cameras.writing import replace_file, written
from rn_perception_camera.options import RosCamerasOptions, VideoCamerasOptions
from roboneuron import ConfigurationError
from roboneuron.command import load_config

PLAIN = """\
# our cell
[robot]
name = "gantry"   # the long one

[perception]
source = "video-camera"

[plugins.video-camera.cameras.front]
device = 0   # at the window
"""
LAYOUTS = {
    "plain": PLAIN,
    "robot behind": PLAIN + "\n# speeds\n[limits]\nmax_speed_m_s = 0.2\n",
    "calibrated before": PLAIN
    + '[robot.cameras.front]\nmount = "tcp"   # was on the hand\nposition_m = [0, 0, 0]\n'
    "quaternion_xyzw = [0, 0, 0, 1]\n",
    "another camera": PLAIN.replace(
        "[perception]",
        '[robot.cameras.hand]\nmount = "tcp"\nposition_m = [0, 0, 0]\n'
        "quaternion_xyzw = [0, 0, 0, 1]\nsize = [64, 48]\nintrinsics = [60, 60, 32, 24]\n"
        "[perception]",
    ),
    "inline": PLAIN.replace(
        "[plugins.video-camera.cameras.front]\ndevice = 0",
        "[plugins.video-camera]\ncameras = { front = { device = 0 } }",
    ),
    "intrinsics of the source": PLAIN
    + "intrinsics = [1.0, 1.0, 1.0, 1.0]\ndistortion = [1,2,3,4]\n",
}


def read_back(text, tmp_path):
    path = tmp_path / "roboneuron.toml"
    path.write_text(text)
    return load_config(path)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_keeps_its_comments_and_gets_the_values(tmp_path, layout):
    text = LAYOUTS[layout]
    new = written(text, "front", "video-camera", "base", calibrated())
    comments = [line.partition("#")[2] for line in text.splitlines() if "#" in line]
    assert [line.partition("#")[2] for line in new.splitlines() if "#" in line] == comments
    config = read_back(new, tmp_path)
    front = config.robot.cameras["front"]
    assert front.mount == "base"
    assert front.position_m == pytest.approx(MOUNTED[:3, 3], abs=1e-5)
    assert front.size == list(SIZE)
    assert front.intrinsics == pytest.approx(MATRIX[[0, 1, 0, 1], [0, 1, 2, 2]], abs=1e-3)
    options = VideoCamerasOptions.model_validate(config.options("video-camera")).cameras["front"]
    assert options.distortion == pytest.approx(DISTORTION, abs=1e-6)
    assert options.intrinsics is None
    assert options.device == 0
    before = read_back(text, tmp_path)
    assert config.robot.cameras.keys() - {"front"} == before.robot.cameras.keys() - {"front"}
    assert config.limits == before.limits


def test_written_again_the_text_stays():
    once = written(PLAIN, "front", "video-camera", "base", calibrated())
    assert written(once, "front", "video-camera", "base", calibrated()) == once


def test_a_lens_that_the_driver_tells_is_left_to_it(tmp_path):
    text = PLAIN.replace("video-camera", "ros-camera").replace(
        "device = 0", 'topic = "/c"\ncamera_info = "/i"\ndistortion = "undistort"'
    )
    config = read_back(
        written(text, "front", "ros-camera", "base", calibrated(is_optics_measured=False)), tmp_path
    )
    assert config.robot.cameras["front"].intrinsics is None
    front = RosCamerasOptions.model_validate(config.options("ros-camera")).cameras["front"]
    assert (front.distortion, front.camera_info) == ("undistort", "/i")


def test_a_topic_gets_the_coefficients(tmp_path):
    text = PLAIN.replace("video-camera", "ros-camera").replace("device = 0", 'topic = "/c"')
    config = read_back(written(text, "front", "ros-camera", "tcp", calibrated()), tmp_path)
    front = RosCamerasOptions.model_validate(config.options("ros-camera")).cameras["front"]
    assert front.distortion == pytest.approx(DISTORTION, abs=1e-6)


def test_one_of_several_robots_gets_it():
    robots = "".join(
        f"[robots.{name}.{line[1:]}\n" if line.startswith("[") else f"{line}\n"
        for name in ("left", "right")
        for line in PLAIN.splitlines()
    )
    new = written(robots, "front", "video-camera", "base", calibrated(), robot="right")
    assert new.count("position_m") == new.count("[robots.right.robot.cameras.front]") == 1


def test_a_source_that_cannot_undistort_is_refused():
    with pytest.raises(ConfigurationError, match="fr3-sim"):
        written(PLAIN, "front", "fr3-sim", "base", calibrated())


def test_a_file_is_replaced_with_its_permissions_also_behind_a_link(tmp_path):
    file, link = tmp_path / "a.toml", tmp_path / "b.toml"
    file.write_text("old")
    file.chmod(0o640)
    link.symlink_to(file)
    replace_file(link, "new")
    assert (file.read_text(), file.stat().st_mode & 0o777, link.is_symlink()) == (
        "new",
        0o640,
        True,
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.toml", "b.toml"]
