"""True cube positions and lift times: for judging, never for policies."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_simulation.cubes import Cube, RawPose

F64 = NDArray[np.float64]

SWITCH = "ROBONEURON_SIMULATOR_TRUTH"
"""Environment variable: drivers report the ground truth in `RobotState.detail` only if it is "on".
Otherwise agents, which read the status, would learn more than the cameras show.
"""
TRUE_POSE_TOPIC = "sim/true_pose"
"""nav_msgs/Odometry: true pose of a simulated base, in the frame of its odometry; for judging and
tests only.
"""
HELD_M, FREE_M = 0.03, 0.08
"""A lifted cube counts as held by an arm whose TCP is within the first distance of its centre, and
as held by that arm alone if all other TCPs are beyond the second.
"""
LIFTED_M = 0.10
"""Minimum height of a cube's centre above its resting position to count as lifted."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CubeState:
    """A cube's true state.

    Attributes:
        name: its colour.
        edge_m: edge length.
        position_m: float64 (3,), centre in the base frame.
        quaternion_xyzw: float64 (4,).
        lifted_m: height of the centre above its height at rest on the table.
        held_s: simulated seconds for which it has been lifted without interruption; 0 if it is not
            lifted.
        holders: names of the arms that hold it; a single arm has the name "".
        handed_over_s: simulated seconds for which only another arm than the one that lifted it has
            held it, without interruption and without being put down; 0 otherwise.
    """

    name: str
    edge_m: float
    position_m: F64
    quaternion_xyzw: F64
    lifted_m: float
    held_s: float
    holders: tuple[str, ...] = ()
    handed_over_s: float = 0.0


class LiftClock:
    """Measures how long each cube has been lifted, by which arm, and since when by another one."""

    def __init__(
        self, scene: Sequence[Cube], arms: Sequence[str] = ("",), lifted_m: float = LIFTED_M
    ) -> None:
        """Args:
        scene: the cubes.
        arms: names of the arms.
        lifted_m: height at which a cube counts as lifted.
        """
        self._threshold_m = lifted_m
        self._edge_m = {cube.name: cube.edge_m for cube in scene}
        self._arms = tuple(arms)
        self._lifted_since_s: dict[str, float] = {}
        self._holders: dict[str, tuple[str, ...]] = {}
        self._lifted_by: dict[str, str] = {}
        self._handed_since_s: dict[str, float] = {}
        self._now_s = 0.0

    def _lifted_m(self, name: str, pose: RawPose) -> float:
        return pose[0][2] - self._edge_m[name] / 2

    def observe(
        self, now_s: float, poses: Mapping[str, RawPose], tcps_m: Sequence[F64] = ()
    ) -> None:
        """Record cube poses by name and the arms' TCPs at simulated time `now_s`; call it at least
        every 1/60 s.
        """
        self._now_s = now_s
        for name, pose in poses.items():
            if self._lifted_m(name, pose) >= self._threshold_m:
                self._lifted_since_s.setdefault(name, now_s)
                self._note_holders(name, now_s, [math.dist(tcp, pose[0]) for tcp in tcps_m])
            else:
                for facts in (self._lifted_since_s, self._handed_since_s):
                    facts.pop(name, None)
                self._lifted_by.pop(name, None)
                self._holders.pop(name, None)

    @property
    def longest_s(self) -> float:
        """Longest time for which a cube has been lifted without interruption [simulated s]; 0 if
        none is.
        """
        return self._now_s - min(self._lifted_since_s.values(), default=self._now_s)

    def _note_holders(self, name: str, now_s: float, distances_m: Sequence[float]) -> None:
        by_arm = dict(zip(self._arms, distances_m, strict=False))
        self._holders[name] = tuple(arm for arm, far in by_arm.items() if far <= HELD_M)
        is_alone = sum(far <= FREE_M for far in by_arm.values()) == 1
        if is_alone and len(self._holders[name]) == 1:
            (holder,) = self._holders[name]
            if self._lifted_by.setdefault(name, holder) != holder:
                self._handed_since_s.setdefault(name, now_s)
                return
        self._handed_since_s.pop(name, None)

    def states(self, poses: Mapping[str, RawPose]) -> dict[str, CubeState]:
        """The cubes' states at the last observed time, by name."""
        return {
            name: CubeState(
                name=name,
                edge_m=self._edge_m[name],
                position_m=np.array(position),
                quaternion_xyzw=np.array(rotation),
                lifted_m=self._lifted_m(name, (position, rotation)),
                held_s=self._now_s - self._lifted_since_s.get(name, self._now_s),
                holders=self._holders.get(name, ()),
                handed_over_s=self._now_s - self._handed_since_s.get(name, self._now_s),
            )
            for name, (position, rotation) in poses.items()
        }


def is_told() -> bool:
    """True if drivers of this process report the ground truth."""
    return os.environ.get(SWITCH, "") == "on"


def told(cubes: Mapping[str, CubeState], seed: int) -> dict[str, str]:
    """Ground truth for a driver's `RobotState.detail`: "cubes" (see `described`) and "seed", which
    defines the scene; empty unless `is_told`.
    """
    return {"cubes": described(cubes), "seed": str(seed)} if is_told() else {}


def described(cubes: Mapping[str, CubeState]) -> str:
    """Ground truth about cubes as reported by a driver: JSON with position, lifted height and held
    time of each; for several arms also the arms holding it and the time since the handover.
    """
    facts = {
        name: {
            "position_m": [round(float(value), 4) for value in cube.position_m],
            "lifted_m": round(cube.lifted_m, 4),
            "held_s": round(cube.held_s, 3),
            **_hand_over(cube),
        }
        for name, cube in cubes.items()
    }
    return json.dumps(facts, separators=(",", ":"))


def _hand_over(cube: CubeState) -> dict[str, object]:
    """Which of several arms hold a cube; empty for a single arm, which has no name."""
    if "" in cube.holders or not cube.holders:
        return {}
    return {"holders": list(cube.holders), "handed_over_s": round(cube.handed_over_s, 3)}
