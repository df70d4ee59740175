"""Evaluation of a served FR3 behind franka-sim from the simulator's files: limits, control loop,
missed cycles.

Acceleration and jerk are those of a cubic fitted to 61 ms of positions, where the simulator itself
was never late by more than 2 ms: it reads the commands with its own clock, so its behaviour within
a few milliseconds depends more on the machine than on the arm.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent))
from fci_cell import STILL_RAD_S, Record, read_record

sys.path.pop(0)

from rn_controller_urdf.collision import CollisionModel
from rn_robot_fr3.description import TCP_LINK, urdf
from rn_robot_fr3.limits import (
    ACCELERATION_RAD_S2,
    ARM_JOINTS,
    JERK_RAD_S3,
    LOWER_RAD,
    UPPER_RAD,
    velocity_bounds,
)
from rn_robot_fr3.profile import WORKSPACE_LOWER_M, WORKSPACE_UPPER_M, profile
from roboneuron import JointSample

F64 = NDArray[np.float64]
WINDOW = 61
STEP_S = 0.001
LATE_S = 0.002
CHUNK_S = 60.0
EVERY = 20
"""Number of rows after which the TCP and the distances are computed."""
MISSING = 2.0
"""Mark in the simulator's record of commands: it had to extrapolate, because none arrived in
time.
"""
_COMMAND_COLUMNS = 11
_BETWEEN_MOTIONS_MS = 25.0
"""After 20 cycles without a command the robot ends a motion, so longer gaps are between two
motions.
"""
_BEFORE_S = 0.003


def fitted(record: Record) -> tuple[F64, F64, float]:
    """Largest |acceleration| and |jerk| (7,) of cubics through `WINDOW` ms of positions, and the
    evaluated fraction.

    It uses the times at which rows were written, because the simulator catches up after delays.
    """
    grid_s = np.arange(record.at_s[0], record.at_s[-1], STEP_S)
    if len(grid_s) < 4 * WINDOW:
        return np.zeros(7), np.zeros(7), 0.0
    position = np.array([np.interp(grid_s, record.at_s, joint) for joint in record.position.T])
    at_s = (np.arange(WINDOW) - WINDOW // 2) * STEP_S
    fit = np.linalg.pinv(np.stack([np.ones(WINDOW), at_s, at_s**2 / 2.0, at_s**3 / 6.0], axis=1))
    late = np.diff(record.at_s, prepend=record.at_s[0]) > LATE_S
    was_late = np.interp(grid_s, record.at_s, late.astype(float)) > 0.0
    kept = np.convolve(was_late, np.ones(2 * WINDOW + 1), mode="same") < 0.5
    kept[: WINDOW + 1] = kept[-WINDOW - 1 :] = False
    greatest = [
        [np.abs(np.convolve(q, k[::-1], mode="same"))[kept].max(initial=0.0) for q in position]
        for k in fit[2:]
    ]
    return np.array(greatest[0]), np.array(greatest[1]), float(kept.mean())


def chunks(record: Record) -> Iterator[Record]:
    """The record in pieces of `CHUNK_S`."""
    for begin_s in np.arange(record.at_s[0], record.at_s[-1], CHUNK_S):
        if len((piece := record.since(begin_s, begin_s + CHUNK_S)).at_s) > 1:
            yield piece


@dataclass(kw_only=True, slots=True)
class Limits:
    """Smallest distances of the simulator's joints from each limit."""

    room_rad: float = np.inf
    velocity_room_rad_s: float = np.inf
    acceleration: float = 0.0
    jerk: float = 0.0
    outside_m: float = -np.inf
    pairs: set[tuple[str, str]] = field(default_factory=set)
    judged_s: float = 0.0
    fitted_s: float = 0.0
    moving_s: float = 0.0

    def add(self, record: Record) -> None:
        """Evaluate another piece."""
        position, velocity = record.position, record.velocity
        lowest, highest = zip(*(velocity_bounds(q) for q in position[::EVERY]), strict=True)
        over = np.maximum(
            velocity[::EVERY] - np.array(highest), np.array(lowest) - velocity[::EVERY]
        ).max()
        room = np.minimum(position - np.array(LOWER_RAD), np.array(UPPER_RAD) - position).min()
        self.velocity_room_rad_s = min(self.velocity_room_rad_s, -float(over))
        self.room_rad = min(self.room_rad, float(room))
        acceleration, jerk, kept = fitted(record)
        self.acceleration = max(
            self.acceleration, float((acceleration / np.array(ACCELERATION_RAD_S2)).max())
        )
        self.jerk = max(self.jerk, float((jerk / np.array(JERK_RAD_S3)).max()))
        lasts_s = float(record.at_s[-1] - record.at_s[0])
        self.judged_s += lasts_s
        self.fitted_s += kept * lasts_s
        self.moving_s += float((np.abs(velocity).max(axis=1) > STILL_RAD_S).mean()) * lasts_s
        self._place(position[::EVERY])

    def _place(self, positions: F64) -> None:
        model = pinocchio.buildModelFromXML(urdf())
        data, frame = model.createData(), model.getFrameId(TCP_LINK)
        robot = profile()
        assert robot.collision is not None
        collisions = CollisionModel(robot, robot.collision)
        for q in positions:
            pinocchio.framesForwardKinematics(model, data, np.append(q, [0.0, 0.0]))
            tcp = data.oMf[frame].translation
            beyond = np.maximum(
                np.array(WORKSPACE_LOWER_M) - tcp, tcp - np.array(WORKSPACE_UPPER_M)
            )
            self.outside_m = max(self.outside_m, float(beyond.max()))
            self.pairs |= {
                (p.first, p.second)
                for p in collisions.near(JointSample(names=ARM_JOINTS, position=q))
            }

    def print(self) -> int:
        """Print rows of the table; returns the number of exceeded limits."""
        room_rad_s, outside_m = self.velocity_room_rad_s, self.outside_m
        facts = {
            f"nearest to a joint limit {self.room_rad:.4f} rad": self.room_rad < 0.0,
            f"least room to the velocity envelope {room_rad_s:.3f} rad/s": room_rad_s < 0.0,
            f"acceleration {self.acceleration:.0%} of 10 rad/s2": self.acceleration > 1.0,
            f"jerk {self.jerk:.0%} of 5000 rad/s3": self.jerk > 1.0,
            f"TCP at most {outside_m * 1e3:.1f} mm beyond the workspace (negative: in)": outside_m
            > 0,
            f"pairs nearer than allowed: {sorted(self.pairs) or 'none'}": bool(self.pairs),
        }
        fit, moving = (
            self.fitted_s / max(self.judged_s, 1e-9),
            self.moving_s / max(self.judged_s, 1e-9),
        )
        print(
            f"| joints judged: {self.judged_s:.0f} s, {fit:.0%} of them for acceleration | moving "
            f"{moving:.0%} |"
        )
        for fact, is_over in facts.items():
            print(f"| {fact} | {'EXCEEDED' if is_over else 'kept'} |")
        return sum(facts.values())


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Loop:
    """The control loop as measured by the simulator.

    Attributes:
        period_ms: float64 (n,), between arrivals of commands, within motions.
        cycles: number of cycles due within motions.
        run_cycles: int (m,), length of each run of cycles without a command.
        run_at_s: float64 (m,), start of each of them, monotonic.
        run_is_wide: bool (m,), True if the physics thread of the simulator was late too, so that
            not only the client was delayed.
    """

    period_ms: F64
    cycles: int
    run_cycles: NDArray[np.int64]
    run_at_s: F64
    run_is_wide: NDArray[np.bool_]


def control_loop(path: Path, record: Record, began_s: float) -> Loop:
    """Read the commands that the simulator recorded since `began_s`."""
    size = path.stat().st_size // (8 * _COMMAND_COLUMNS)
    rows: Any = np.memmap(path, dtype=np.float64, mode="r", shape=(size, _COMMAND_COLUMNS))
    rows = np.array(rows[:, [0, 2]])
    rows = rows[rows[:, 0] > began_s]
    is_missing = np.concatenate([[False], rows[:, 1] == MISSING, [False]])
    edges = np.flatnonzero(np.diff(is_missing.astype(np.int8)))
    first, last = edges[::2], edges[1::2]
    run_cycles = last - first
    pause_s = np.diff(record.at_s, prepend=record.at_s[:1])
    is_wide = np.zeros(len(first), dtype=np.bool_)
    for index, (begin, end) in enumerate(zip(first, last, strict=True)):
        low, high = np.searchsorted(
            record.at_s, [rows[begin, 0] - _BEFORE_S, rows[end - 1, 0] + STEP_S]
        )
        is_wide[index] = pause_s[low : high + 1].max(initial=0.0) > LATE_S
    arrivals = rows[rows[:, 1] != MISSING, 0]
    period_ms = np.diff(arrivals) * 1e3
    return Loop(
        period_ms=period_ms[period_ms < _BETWEEN_MOTIONS_MS],
        cycles=len(rows),
        run_cycles=run_cycles,
        run_at_s=rows[first, 0],
        run_is_wide=is_wide,
    )


def print_loops(loops: list[Loop]) -> None:
    """Print rows of the table."""
    period_ms = np.concatenate([loop.period_ms for loop in loops])
    runs = np.concatenate([loop.run_cycles for loop in loops])
    wide = np.concatenate([loop.run_is_wide for loop in loops])
    if len(period_ms):
        print(
            f"| period of the control loop, by {len(period_ms)} commands as they arrived | p50 "
            f"{np.median(period_ms):.2f} ms, p99 {np.percentile(period_ms, 99):.2f} ms, p99.9 "
            f"{np.percentile(period_ms, 99.9):.2f} ms, longest {period_ms.max():.1f} ms |"
        )
    print(
        f"| cycles without a command | {runs.sum()} of {sum(loop.cycles for loop in loops)}, in "
        f"{len(runs)} runs, the "
        f"longest {runs.max(initial=0)}; in {int(wide.sum())} of the runs the simulator's physics "
        "was late, too |"
    )


def read_go(folder: Path, began_s: float, limits: Limits) -> Loop | None:
    """Evaluate the files of a run below `folder` since `began_s`; None if there are none."""
    record = read_record(folder / "record.bin").since(began_s)
    if len(record.at_s) < 2:
        return None
    for piece in chunks(record):
        limits.add(piece)
    return control_loop(folder / "record.bin.commands", record, began_s)
