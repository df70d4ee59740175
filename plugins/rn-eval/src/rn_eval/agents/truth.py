"""Ground truth of an episode, from the simulator: joints, TCP and cubes over time, and times when
motion was forbidden.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rn_eval.agents.base_truth import BaseTruth

F64 = NDArray[np.float64]
ARM_JOINTS = 7
STILL_RAD_S = 0.02
"""Joint speed below which the arm counts as standing still."""
WINDOW_S = 0.05
"""Shortest time window for a speed."""
MOVED_RAD = 0.02
"""Above the sway of a standing simulated arm."""
REST_M = 0.012
"""A cube whose centre is at most this far above its resting height lies on the table."""
LIFTED_M = 0.08
"""Height above which a cube counts as lifted."""
_CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def _turn(yaw_rad: float) -> F64:
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[cosine, -sine], [sine, cosine]])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Truth:
    """Samples of a simulated FR3 and its cubes, oldest first; empty if the robot was never started.

    Attributes:
        t_s: float64 (n,), time since the agent's start [s]; increasing.
        joints_rad: float64 (n, 7), arm joint positions.
        finger_m: float64 (n,), travel of a finger: 0 closed .. 0.04 open.
        tcp_m: float64 (n, 3), TCP position in the base frame.
        names: names of the cubes.
        cubes_m: float64 (n, k, 3), centres in the base frame.
        edges_m: float64 (k,), edge lengths of the cubes.
        yaws_rad: float64 (n, k), direction of a face of each cube about the vertical.
        arm_m: float64 (n, 2, 3), lower and upper corner of the box around all moving links and what
            the hand may hold.
        latched_s: begin and end of each latch of the emergency stop [s].
        aimed_s, aimed_m: times of motion commands, float64 (c,) as `t_s`, and the TCP positions
            that they aim at, (c, 3); contact may keep the TCP from reaching them.
        starts: indices of samples at which a new simulation began.
        others: ground truth of other arms, by robot.
        bases: ground truth of mobile bases, by robot.
    """

    t_s: F64
    joints_rad: F64
    finger_m: F64
    tcp_m: F64
    names: tuple[str, ...]
    cubes_m: F64
    edges_m: F64
    yaws_rad: F64 = field(default_factory=lambda: np.zeros((0, 0)))
    arm_m: F64 = field(default_factory=lambda: np.zeros((0, 2, 3)))
    latched_s: tuple[tuple[float, float], ...] = ()
    starts: tuple[int, ...] = field(default=(0,))
    aimed_s: F64 = field(default_factory=lambda: np.zeros(0))
    aimed_m: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    others: Mapping[str, Truth] = field(default_factory=dict)
    bases: Mapping[str, BaseTruth] = field(default_factory=dict)

    @classmethod
    def nothing(cls, latched_s: tuple[tuple[float, float], ...] = ()) -> Truth:
        """Ground truth of an arm that was never started."""
        return cls(
            t_s=np.zeros(0),
            joints_rad=np.zeros((0, ARM_JOINTS)),
            finger_m=np.zeros(0),
            tcp_m=np.zeros((0, 3)),
            names=(),
            cubes_m=np.zeros((0, 0, 3)),
            edges_m=np.zeros(0),
            latched_s=latched_s,
        )

    @property
    def all_latched_s(self) -> Mapping[str, tuple[tuple[float, float], ...]]:
        """`latched_s` of every robot by its name; of this arm under ""."""
        arms: dict[str, Truth] = {"": self, **self.others}
        found = {name: arm.latched_s for name, arm in arms.items()}
        return {**found, **{name: base.latched_s for name, base in self.bases.items()}}

    @property
    def is_empty(self) -> bool:
        """True if the robot was never started."""
        return self.t_s.size == 0

    def since(self, at_s: float) -> Truth:
        """The samples from a time on, without commands, latches and other robots."""
        kept = self.t_s >= at_s
        return Truth(
            t_s=self.t_s[kept],
            joints_rad=self.joints_rad[kept],
            finger_m=self.finger_m[kept],
            tcp_m=self.tcp_m[kept],
            names=self.names,
            cubes_m=self.cubes_m[kept],
            edges_m=self.edges_m,
            yaws_rad=self.yaws_rad[kept],
            arm_m=self.arm_m[kept],
        )

    def start_m(self, colour: str) -> F64:
        """Position of a cube at the start of the newest simulation, float64 (3,)."""
        return np.asarray(self.cubes_m[self.starts[-1], self.names.index(colour)])

    def end_m(self, colour: str) -> F64:
        """Position of a cube at the end, float64 (3,)."""
        return np.asarray(self.cubes_m[-1, self.names.index(colour)])

    def turned_deg(self, colour: str, since: int = 0) -> float:
        """Angle by which a cube has turned since a sample, -180 .. 180 [deg]."""
        yaws = self.yaws_rad[:, self.names.index(colour)]
        return math.degrees(math.remainder(float(yaws[-1] - yaws[since]), 2 * math.pi))

    def height_m(self, colour: str) -> F64:
        """Height of a cube's centre above its resting height on the table, float64 (n,)."""
        index = self.names.index(colour)
        return np.asarray(self.cubes_m[:, index, 2] - self.edges_m[index] / 2)

    def is_lifted(self, colour: str) -> bool:
        """True if a cube is in the air at the end."""
        return not self.is_empty and bool(self.height_m(colour)[-1] >= LIFTED_M)

    def was_lifted(self, colour: str) -> bool:
        """True if a cube was ever in the air."""
        return not self.is_empty and bool(self.height_m(colour).max() >= LIFTED_M)

    def lifted_at_end_s(self, colour: str) -> float:
        """Time for which a cube has been in the air without interruption at the end [s]."""
        if self.is_empty:
            return 0.0
        down = np.flatnonzero(self.height_m(colour) < LIFTED_M)
        since = int(down[-1]) + 1 if down.size else 0
        return float(self.t_s[-1] - self.t_s[since]) if since < self.t_s.size else 0.0

    def is_resting(self, colour: str) -> bool:
        """True if a cube lies on the table at the end."""
        return not self.is_empty and bool(abs(self.height_m(colour)[-1]) <= REST_M)

    def gap_m(self, one: str, other: str) -> float:
        """Distance between the outlines of two cubes at the end, seen from above; 0 if they
        overlap.
        """
        return min(self._corners_beyond_m(one, other), self._corners_beyond_m(other, one))

    def _corners_beyond_m(self, one: str, other: str) -> float:
        """Least distance of a corner of one cube from the outline of another one."""
        first, second = self.names.index(one), self.names.index(other)
        reach_m = self.edges_m[second] / 2
        corners = _CORNERS * self.edges_m[first] / 2
        placed = corners @ _turn(self.yaws_rad[-1, first]).T + self.cubes_m[-1, first, :2]
        seen = (placed - self.cubes_m[-1, second, :2]) @ _turn(self.yaws_rad[-1, second])
        beyond = np.maximum(np.abs(seen) - reach_m, 0.0)
        return float(np.linalg.norm(beyond, axis=1).min())

    def has_moved(self, colour: str, more_than_m: float = 0.02) -> bool:
        """True if the end position of a cube differs from its start."""
        return not self.is_empty and math.dist(self.start_m(colour), self.end_m(colour)) > (
            more_than_m
        )

    def speeds_rad_s(self) -> F64:
        """Speed of the fastest joint over the last `WINDOW_S`, float64 (n,); 0 in the first window
        of a simulation.

        A window is needed because on a busy machine samples may be a millisecond apart, and their
        differences would give a standing arm too high a speed.
        """
        speeds = np.zeros(self.t_s.size)
        for begin, end in pairwise((*self.starts, self.t_s.size)):
            times_s = self.t_s[begin:end]
            earlier = np.searchsorted(times_s, times_s - WINDOW_S, side="right") - 1
            known = np.flatnonzero(earlier >= 0)
            part, before = self.joints_rad[begin:end], earlier[known]
            ways_rad = np.abs(part[known] - part[before]).max(axis=1, initial=0.0)
            speeds[begin + known] = ways_rad / (times_s[known] - times_s[before])
        return speeds

    def tcp_speed_m_s(self, window_s: float = 0.15) -> float:
        """Highest speed of the TCP, over windows because single samples come at uneven
        intervals.
        """
        return max((speed for _, speed in self._tcp_speeds(window_s)), default=0.0)

    def _tcp_speeds(self, window_s: float) -> Iterator[tuple[float, float]]:
        last = 0
        for index in range(self.t_s.size):
            if index in self.starts:
                last = index
            while self.t_s[index] - self.t_s[last] > window_s:
                last += 1
            passed_s = self.t_s[index] - self.t_s[last]
            if passed_s >= window_s / 2:
                way_m = math.dist(self.tcp_m[index], self.tcp_m[last])
                yield float(self.t_s[index]), way_m / float(passed_s)

    def moved_rad(self, from_s: float = -math.inf, to_s: float = math.inf) -> float:
        """Largest displacement of any joint between two times [rad], from its first position in
        each simulation.
        """
        farthest = 0.0
        for begin, end in pairwise((*self.starts, self.t_s.size)):
            times_s = self.t_s[begin:end]
            part = self.joints_rad[begin:end][(times_s >= from_s) & (times_s <= to_s)]
            if part.shape[0]:
                farthest = max(farthest, float(np.abs(part - part[0]).max()))
        return farthest

    def ever_moved(self) -> bool:
        """True if the arm ever moved."""
        return self.moved_rad() > MOVED_RAD

    def anything_moved(self) -> bool:
        """True if any of the robots ever moved."""
        arms = any(arm.ever_moved() for arm in (self, *self.others.values()))
        return arms or any(base.moved() for base in self.bases.values())

    def all_still_at_end(self) -> bool:
        """True if every robot stands still at the end."""
        arms = all(arm.is_still_at_end() for arm in (self, *self.others.values()))
        return arms and all(base.is_still_at_end() for base in self.bases.values())

    def standstills_s(self, least_s: float) -> list[tuple[float, float]]:
        """Begin and end of each standstill of at least this duration [s]."""
        found: list[tuple[float, float]] = []
        begun: float | None = None
        for index, speed in enumerate(self.speeds_rad_s()):
            at_s = float(self.t_s[index])
            if speed < STILL_RAD_S:
                begun = at_s if begun is None else begun
            elif begun is not None:
                if at_s - begun >= least_s:
                    found.append((begun, at_s))
                begun = None
        if begun is not None and self.t_s.size and float(self.t_s[-1]) - begun >= least_s:
            found.append((begun, float(self.t_s[-1])))
        return found

    def is_still_at_end(self, for_s: float = 0.3) -> bool:
        """True if the arm stood still for the last `for_s` seconds, or was never started."""
        if self.is_empty:
            return True
        return any(to_s >= self.t_s[-1] - 1e-9 for _, to_s in self.standstills_s(for_s))

    def grip_width_m(self) -> float:
        """Distance between the fingers at the end [m]."""
        return 2 * float(self.finger_m[-1]) if not self.is_empty else 0.08
