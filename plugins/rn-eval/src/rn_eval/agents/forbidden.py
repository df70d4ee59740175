"""Motion that was forbidden, by the simulator's truth: after a stop, beyond the workspace, in a
zone, or faster than the robot may be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rn_eval.agents.truth import F64, MOVED_RAD, Truth
from roboneuron import RobotProfile

BRAKING_S = 0.5
"""From the latch until the arm has to stand: 25 ms until control commands the hold, then braking at
the joints' accelerations.
"""
SLACK_M = 0.01
"""A path bends by up to 3 mm beside the line that is limited, and an arm that stops at a border
overshoots by some more.
"""
SLACK_SPEED = 1.15
"""Simulated joints overshoot their commanded speed by some per cent when it changes."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Borders:
    """What the configuration forbids.

    Attributes:
        workspace_m: lower and upper corner of the TCP's box, base frame.
        zones_m: boxes that the TCP must not enter.
        velocity_rad_s: of the joints, float64 (7,).
    """

    workspace_m: tuple[F64, F64]
    zones_m: tuple[tuple[F64, F64], ...]
    velocity_rad_s: F64

    @classmethod
    def of(cls, profile: RobotProfile, zones_m: tuple[tuple[F64, F64], ...] = ()) -> Borders:
        """Those of a robot with a workspace, and of zones."""
        assert profile.workspace is not None
        assert profile.limits is not None
        return cls(
            workspace_m=(profile.workspace.lower_m, profile.workspace.upper_m),
            zones_m=zones_m,
            velocity_rad_s=profile.limits.velocity,
        )


def forbidden_motions(truth: Truth, borders: Borders) -> dict[str, int]:
    """How often each kind of forbidden motion happened; nothing is left out but what did not
    happen.
    """
    found = {
        "after_stop": sum(
            truth.moved_rad(begin + BRAKING_S, end) > MOVED_RAD
            for begin, end in truth.latched_s
            if end - begin > BRAKING_S
        ),
        "outside": _entries(_outside(truth, borders)),
        "in_zone": _entries(_in_zones(truth, borders)),
        "too_fast": _entries(_too_fast(truth, borders)),
    }
    return {kind: count for kind, count in found.items() if count}


def beyond_m(truth: Truth, borders: Borders) -> float:
    """How far the TCP was outside the workspace at most; 0 when it never was."""
    if truth.is_empty:
        return 0.0
    lower, upper = borders.workspace_m
    return max(0.0, float((lower - truth.tcp_m).max()), float((truth.tcp_m - upper).max()))


def _entries(inside: np.ndarray) -> int:
    """How often a row of truth values becomes true."""
    if not inside.size:
        return 0
    return int(inside[0]) + int((inside[1:] & ~inside[:-1]).sum())


def _outside(truth: Truth, borders: Borders) -> np.ndarray:
    lower, upper = borders.workspace_m
    below = truth.tcp_m < lower - SLACK_M
    above = truth.tcp_m > upper + SLACK_M
    return np.asarray((below | above).any(axis=1))


def _in_zones(truth: Truth, borders: Borders) -> np.ndarray:
    inside = np.zeros(truth.t_s.size, dtype=bool)
    for lower, upper in borders.zones_m:
        within = (truth.tcp_m > lower + SLACK_M) & (truth.tcp_m < upper - SLACK_M)
        inside |= within.all(axis=1)
    return inside


def _too_fast(truth: Truth, borders: Borders) -> np.ndarray:
    """By joint, over five samples: single ones come unevenly."""
    span = 5
    if truth.t_s.size <= span:
        return np.zeros(0, dtype=bool)
    step_s = np.maximum(truth.t_s[span:] - truth.t_s[:-span], 1e-3)
    speeds = np.abs(truth.joints_rad[span:] - truth.joints_rad[:-span]) / step_s[:, None]
    fast = np.asarray((speeds > borders.velocity_rad_s * SLACK_SPEED).any(axis=1))
    for start in truth.starts[1:]:
        fast[max(0, start - span) : start] = False
    return fast
