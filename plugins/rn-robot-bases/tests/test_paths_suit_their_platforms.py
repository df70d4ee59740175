"""The predefined paths are drivable, followed to their end, and can be rendered."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rn_robot_bases.paths import PATHS, Segment, planned_track
from rn_robot_bases.picture import draw_track
from rn_robot_bases.platform import DIFFDRIVE, PLATFORMS, RACECAR, Platform
from rn_robot_bases.profile import check_twist
from rn_robot_bases.simulation import BaseSimulation
from rn_simulation.engine import Engine
from rn_simulation.planar_motion import PlanarPose
from roboneuron.errors import InvalidInputError, RefusedError

EVERY_PLATFORM = pytest.mark.parametrize("platform", PLATFORMS.values(), ids=PLATFORMS.keys())


@EVERY_PLATFORM
def test_every_segment_of_a_path_is_possible(platform: Platform) -> None:
    for segment in PATHS[platform.name].segments:
        check_twist(platform, segment.linear_m_s, segment.angular_rad_s)


def test_the_square_is_none_for_a_car() -> None:
    corner = next(s for s in PATHS["diffdrive"].segments if s.angular_rad_s)
    with pytest.raises(RefusedError, match="on the spot"):
        check_twist(RACECAR, corner.linear_m_s, corner.angular_rad_s)


@pytest.mark.sampled(every=3)
@EVERY_PLATFORM
def test_base_ends_where_its_path_is_planned_to_end(engine: Engine, platform: Platform) -> None:
    path = PATHS[platform.name]
    with BaseSimulation(platform, engine=engine) as base:
        for segment in path.segments:
            base.run(segment.linear_m_s, segment.angular_rad_s, segment.duration_s)
        base.hold()
        base.step(240)
        reached = base.state().odometry
    planned = planned_track(platform, path.segments)[-1]
    # Half of the path's tolerance, because no duration scatters here.
    assert math.hypot(reached.x_m - planned.x_m, reached.y_m - planned.y_m) < path.end_m / 2.0
    assert abs(reached.yaw_rad - planned.yaw_rad) < path.end_rad / 2.0


def test_square_comes_back_to_its_start() -> None:
    end = planned_track(DIFFDRIVE, PATHS["diffdrive"].segments)[-1]
    assert math.hypot(end.x_m, end.y_m) < 1e-3
    assert end.yaw_rad == pytest.approx(2.0 * math.pi, abs=1e-3)


def test_track_is_drawn_with_its_robots(engine: Engine) -> None:
    track = planned_track(DIFFDRIVE, [Segment(linear_m_s=0.5, angular_rad_s=0.5, duration_s=4.0)])
    image = draw_track(DIFFDRIVE, track, copies=3, width=160, height=120, engine=engine)
    assert image.shape == (120, 160, 3)
    assert image.dtype == np.uint8
    red, blue = image[:, :, 0].astype(int), image[:, :, 2].astype(int)
    assert int((red - blue > 60).sum()) > 30, "the line and the marks on the decks are orange"
    assert int((blue - red > 40).sum()) > 30, "the bodies are blue"


def test_picture_of_no_track_is_refused(engine: Engine) -> None:
    with pytest.raises(InvalidInputError, match="without poses"):
        draw_track(DIFFDRIVE, [], engine=engine)
    assert draw_track(
        DIFFDRIVE, [PlanarPose()], copies=1, width=64, height=48, engine=engine
    ).shape == (48, 64, 3)
