"""A test path for each platform that suits its steering: velocities and durations, as a client
would publish them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from rn_robot_bases.platform import Platform
from rn_simulation.planar_motion import PlanarPose, integrate

_TRACK_STEP_S = 0.02


@dataclass(frozen=True, kw_only=True, slots=True)
class Segment:
    """A constant velocity: forwards [m/s], turning counter-clockwise [rad/s], for a duration
    [s].
    """

    linear_m_s: float
    angular_rad_s: float
    duration_s: float


@dataclass(frozen=True, kw_only=True, slots=True)
class DrivenPath:
    """A path and its accuracy requirements.

    Attributes:
        name: shape of the path.
        segments: velocities to publish, one after the other.
        end_m, end_rad: tolerated distance of position and heading from `planned_track` at the end,
            by odometry. They allow for 30 ms of scatter in each duration, in the same direction.
    """

    name: str
    segments: tuple[Segment, ...]
    end_m: float
    end_rad: float

    @property
    def duration_s(self) -> float:
        """Duration of all segments."""
        return sum(segment.duration_s for segment in self.segments)

    @property
    def length_m(self) -> float:
        """Distance driven."""
        return sum(abs(segment.linear_m_s) * segment.duration_s for segment in self.segments)


def planned_track(platform: Platform, segments: Sequence[Segment]) -> list[PlanarPose]:
    """Poses at 50 Hz of a base that keeps its acceleration limits and never slips, until it stands
    after the last segment.

    A base that drives the same segments is judged by its distance to the last pose.
    """
    drivetrain, poses = platform.drivetrain(), [PlanarPose()]
    for segment in (*segments, _STOP):
        steps = max(1, round(segment.duration_s / _TRACK_STEP_S))
        step_s = segment.duration_s / steps
        for _ in range(steps):
            drivetrain.aim(segment.linear_m_s, segment.angular_rad_s)
            targets = drivetrain.advance(step_s)
            poses.append(
                integrate(poses[-1], drivetrain.measure(targets.velocity, targets.position), step_s)
            )
    return poses


_STOP = Segment(linear_m_s=0.0, angular_rad_s=0.0, duration_s=1.5)
_PAUSE = Segment(linear_m_s=0.0, angular_rad_s=0.0, duration_s=0.6)


def _square(side_m: float, speed_m_s: float, turning_rad_s: float) -> tuple[Segment, ...]:
    side = Segment(linear_m_s=speed_m_s, angular_rad_s=0.0, duration_s=side_m / speed_m_s)
    corner = Segment(
        linear_m_s=0.0, angular_rad_s=turning_rad_s, duration_s=math.pi / 2.0 / turning_rad_s
    )
    return (side, _PAUSE, corner, _PAUSE) * 4


def _figure_of_eight(radius_m: float, speed_m_s: float) -> tuple[Segment, ...]:
    turning = speed_m_s / radius_m
    duration_s = 2.0 * math.pi / turning
    circles = (
        Segment(linear_m_s=speed_m_s, angular_rad_s=sign * turning, duration_s=duration_s)
        for sign in (1.0, -1.0)
    )
    return (Segment(linear_m_s=speed_m_s, angular_rad_s=0.0, duration_s=1.0), *circles)


def _slalom(
    bends: int, speed_m_s: float, turning_rad_s: float, bend_s: float
) -> tuple[Segment, ...]:
    """A run-up, half a bend, whole bends to alternating sides, half a bend."""
    signs = [1.0 if index % 2 == 0 else -1.0 for index in range(bends + 2)]
    durations_s = [bend_s / 2.0, *[bend_s] * bends, bend_s / 2.0]
    curves = (
        Segment(linear_m_s=speed_m_s, angular_rad_s=sign * turning_rad_s, duration_s=duration_s)
        for sign, duration_s in zip(signs, durations_s, strict=True)
    )
    return (Segment(linear_m_s=speed_m_s, angular_rad_s=0.0, duration_s=1.0), *curves)


PATHS: Mapping[str, DrivenPath] = MappingProxyType(
    {
        "diffdrive": DrivenPath(
            name="square", segments=_square(1.0, 0.4, 0.8), end_m=0.15, end_rad=0.15
        ),
        "husky": DrivenPath(
            name="figure of eight", segments=_figure_of_eight(1.2, 0.7), end_m=0.40, end_rad=0.20
        ),
        "racecar": DrivenPath(
            name="slalom", segments=_slalom(3, 0.8, 1.0, 1.8), end_m=0.45, end_rad=0.30
        ),
    }
)
"""Path by robot name."""
