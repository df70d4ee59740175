"""The simulator's truth of an episode: where joints, TCP and cubes were, and when motion was
forbidden.
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
"""Joint speed below which the arm stands."""
WINDOW_S = 0.05
"""Shortest time over which a speed is measured."""
MOVED_RAD = 0.02
"""A standing simulated arm sways less."""
REST_M = 0.012
"""A cube whose centre is at most so much above its height at rest lies on the table."""
LIFTED_M = 0.08
"""From here on it is lifted."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Truth:
    """Samples of a simulated FR3 and its cubes, oldest first; none before the robot was started.

    Attributes:
        t_s: float64 (n,), since the agent's start [s]; increasing.
        joints_rad: float64 (n, 7), of the arm.
        finger_m: float64 (n,), travel of a finger: 0 closed .. 0.04 open.
        tcp_m: float64 (n, 3), in the base frame.
        names: of the cubes.
        cubes_m: float64 (n, k, 3), centres in the base frame.
        edges_m: float64 (k,), of the cubes.
        latched_s: when the emergency stop was latched, each from .. to [s].
        aimed_s, aimed_m: when the arm was commanded to go somewhere, float64 (c,) as `t_s`, and
            where the TCP would be then, (c, 3); what is touched may hold or push it elsewhere.
        starts: numbers of samples with which a new simulation began.
        others: the same of other arms, by robot.
        bases: of mobile bases, by robot.
    """

    t_s: F64
    joints_rad: F64
    finger_m: F64
    tcp_m: F64
    names: tuple[str, ...]
    cubes_m: F64
    edges_m: F64
    latched_s: tuple[tuple[float, float], ...] = ()
    starts: tuple[int, ...] = field(default=(0,))
    aimed_s: F64 = field(default_factory=lambda: np.zeros(0))
    aimed_m: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    others: Mapping[str, Truth] = field(default_factory=dict)
    bases: Mapping[str, BaseTruth] = field(default_factory=dict)

    @classmethod
    def nothing(cls, latched_s: tuple[tuple[float, float], ...] = ()) -> Truth:
        """Of an arm that was never started."""
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
        """`latched_s` of every robot by its name; that of this arm by ""."""
        arms: dict[str, Truth] = {"": self, **self.others}
        found = {name: arm.latched_s for name, arm in arms.items()}
        return {**found, **{name: base.latched_s for name, base in self.bases.items()}}

    @property
    def is_empty(self) -> bool:
        """The robot was never started."""
        return self.t_s.size == 0

    def start_m(self, colour: str) -> F64:
        """Where a cube lay when the newest simulation began, float64 (3,)."""
        return np.asarray(self.cubes_m[self.starts[-1], self.names.index(colour)])

    def end_m(self, colour: str) -> F64:
        """Where it is at the end, float64 (3,)."""
        return np.asarray(self.cubes_m[-1, self.names.index(colour)])

    def height_m(self, colour: str) -> F64:
        """Of its centre above its height at rest on the table, float64 (n,)."""
        index = self.names.index(colour)
        return np.asarray(self.cubes_m[:, index, 2] - self.edges_m[index] / 2)

    def is_lifted(self, colour: str) -> bool:
        """Whether it is in the air at the end."""
        return not self.is_empty and bool(self.height_m(colour)[-1] >= LIFTED_M)

    def was_lifted(self, colour: str) -> bool:
        """Whether it ever was."""
        return not self.is_empty and bool(self.height_m(colour).max() >= LIFTED_M)

    def lifted_at_end_s(self, colour: str) -> float:
        """For how long it has been in the air at the end, without a break [s]."""
        if self.is_empty:
            return 0.0
        down = np.flatnonzero(self.height_m(colour) < LIFTED_M)
        since = int(down[-1]) + 1 if down.size else 0
        return float(self.t_s[-1] - self.t_s[since]) if since < self.t_s.size else 0.0

    def is_resting(self, colour: str) -> bool:
        """Whether it lies on the table at the end."""
        return not self.is_empty and bool(abs(self.height_m(colour)[-1]) <= REST_M)

    def has_moved(self, colour: str, more_than_m: float = 0.02) -> bool:
        """Whether a cube lies elsewhere than at first."""
        return not self.is_empty and math.dist(self.start_m(colour), self.end_m(colour)) > (
            more_than_m
        )

    def speeds_rad_s(self) -> F64:
        """Speed of the fastest joint over the last `WINDOW_S`, float64 (n,); 0 in the first part of
        a simulation.

        On a busy machine samples come a millisecond apart: by their differences a standing arm
        would sway too fast.
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
        """Highest speed of the TCP, over windows: single samples come unevenly."""
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
        """How far the joint that moved most went between two times, from where it was at first in
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
        """Whether the arm moved at all."""
        return self.moved_rad() > MOVED_RAD

    def anything_moved(self) -> bool:
        """Whether any of all robots did."""
        arms = any(arm.ever_moved() for arm in (self, *self.others.values()))
        return arms or any(base.moved() for base in self.bases.values())

    def all_still_at_end(self) -> bool:
        """Whether every robot stands at the end."""
        arms = all(arm.is_still_at_end() for arm in (self, *self.others.values()))
        return arms and all(base.is_still_at_end() for base in self.bases.values())

    def standstills_s(self, least_s: float) -> list[tuple[float, float]]:
        """When the arm stood for at least so long, each from .. to [s]."""
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
        """Whether the arm has stood for so long at the end; also when it was never started."""
        if self.is_empty:
            return True
        return any(to_s >= self.t_s[-1] - 1e-9 for _, to_s in self.standstills_s(for_s))

    def grip_width_m(self) -> float:
        """Distance between the fingers at the end."""
        return 2 * float(self.finger_m[-1]) if not self.is_empty else 0.08
