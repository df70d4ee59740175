"""An arm of seven joints that follows a known course, the actions recorded on it, and a policy that
knows them, with wiring faults to seed.

The policy sees which moment it is by the picture, so a wrong picture is a wrong
answer. What it answers is a little wrong, as of any policy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from roboneuron import (
    EE_DELTA,
    GRIPPER,
    ActionChunk,
    CameraProfile,
    Channel,
    ControlSpace,
    GripperProfile,
    Observation,
    RobotProfile,
)

F64 = NDArray[np.float64]
ROWS, HORIZON, RATE_HZ = 120, 8, 10.0
JOINTS = tuple(f"joint{i}" for i in range(1, 8))
FINGER = "finger"
SIZE, DIGITS, LEVELS, DARKEST = 32, 16, 15, 8
"""Pictures: size [px]; the row's digits to that base are the brightness of both halves, so many
levels of 255 apart: more than a codec takes.
"""


def arm_profile() -> RobotProfile:
    """Seven hinges, a gripper that opens by 0.08 m, one camera."""
    return RobotProfile(
        name="toy",
        arm_joints=JOINTS,
        gripper=GripperProfile(joint=FINGER, closed_position=0.0, open_position=0.08),
        cameras=(
            CameraProfile(
                name="front", role="primary", frame_id="front_optical", width=32, height=32
            ),
        ),
    )


def joint_space(kind: str) -> ControlSpace:
    """The arm's joints and its gripper."""
    unit = "rad/s" if kind == "joint_velocity" else "rad"
    channels = [Channel(name=name, unit=unit) for name in JOINTS]
    return ControlSpace(
        kind=kind,
        channels=(*channels, Channel(name=GRIPPER, unit="opening")),
        rate_hz=RATE_HZ if kind == "joint_velocity" else 0.0,
    )


SPACES = {
    "ee_delta": EE_DELTA,
    "joint_position": joint_space("joint_position"),
    "joint_velocity": joint_space("joint_velocity"),
}


MARGIN = 60
"""Rows of the course before and after the episode."""


@dataclass(frozen=True)
class Course:
    """What the arm does, from row -MARGIN to ROWS + MARGIN."""

    joints: F64
    positions_m: F64
    quaternions: F64
    openings: F64


def _course() -> Course:
    """Reaches and returns of different length in each joint, two grasps."""
    random = np.random.default_rng(7)
    time_s = np.arange(-MARGIN, ROWS + MARGIN) / RATE_HZ
    joints = np.zeros((len(time_s), 7))
    for joint in range(7):
        for period_s in (7.3, 4.1, 2.6):
            size = random.uniform(0.05, 0.3)
            phase = random.uniform(0.0, 2 * np.pi)
            joints[:, joint] += size * np.sin(2 * np.pi * time_s / period_s + phase)
    joints += np.array([0.1, -0.6, 0.2, -1.9, 0.1, 1.6, 0.7])
    positions_m = 0.3 * joints[:, :3] + np.array([0.4, 0.1, 0.5])
    turn = 0.4 * joints[:, 4] + 0.9
    quaternions = np.zeros((len(time_s), 4))
    quaternions[:, 0], quaternions[:, 3] = np.sin(turn / 2), np.cos(turn / 2)
    openings = ((time_s % 6.0) < 3.4).astype(np.float64)
    return Course(joints, positions_m, quaternions, openings)


COURSE = _course()
_INSIDE = slice(MARGIN, MARGIN + ROWS)
STATE_JOINTS = COURSE.joints[_INSIDE]
STATE_POSES = np.hstack([COURSE.positions_m, COURSE.quaternions])[_INSIDE]
STATE_OPENINGS = COURSE.openings[_INSIDE]


def actions(kind: str) -> F64:
    """Actions of the whole course, float64 (MARGIN + ROWS + MARGIN, C)."""
    after = np.roll(COURSE.joints, -1, axis=0)
    if kind == "joint_position":
        motion = after
    elif kind == "joint_velocity":
        motion = (after - COURSE.joints) * RATE_HZ
    else:
        moved = np.roll(COURSE.positions_m, -1, axis=0) - COURSE.positions_m
        turned = 0.4 * (after - COURSE.joints)[:, [3, 4, 6]]
        motion = np.hstack([moved, turned])
    motion[-1] = motion[-2]
    return np.hstack([motion, COURSE.openings[:, None]])


def recorded(kind: str) -> F64:
    """Actions of the episode, float64 (ROWS, C)."""
    return actions(kind)[_INSIDE]


def picture(row: int) -> NDArray[np.uint8]:
    """Of a row."""
    image = np.empty((SIZE, SIZE, 3), dtype=np.uint8)
    image[:, : SIZE // 2], image[:, SIZE // 2 :] = (
        DARKEST + LEVELS * digit for digit in divmod(row, DIGITS)
    )
    return image


def row_of(image: NDArray[np.uint8]) -> int:
    """The row that a picture shows."""
    quarter = SIZE // 4
    high, low = (
        round((float(half[:, quarter // 2 : -quarter // 2].mean()) - DARKEST) / LEVELS)
        for half in (image[:, : SIZE // 2], image[:, SIZE // 2 :])
    )
    return high * DIGITS + low


@dataclass(frozen=True)
class Asked:
    """What a fault may use.

    Attributes:
        kind: of the space.
        row: of the episode, whose picture was seen.
        error: of the policy itself, float64 (K, C).
    """

    kind: str
    row: int
    error: F64

    def rows(self, first: float = 0.0, step: float = 1.0) -> F64:
        """The policy's actions from `row + first` on, float64 (K, C); displacements are not
        scaled.
        """
        at = MARGIN + self.row + first + step * np.arange(len(self.error))
        values = actions(self.kind)
        found = [np.interp(at, np.arange(len(values)), column) for column in values.T]
        return np.stack(found, axis=1) + self.error


Fault = Callable[[Asked], F64]


class KnowingPolicy:
    """A backend that answers with the recorded actions of the moment that it sees.

    Args:
        kind: of its space.
        fault: what makes its answers wrong.
        noise: its own error, in shares of each channel's spread.
        gain: how far it goes: less than 1 for a timid one.
    """

    def __init__(
        self,
        kind: str,
        fault: Fault | None = None,
        *,
        noise: float = 0.08,
        gain: float = 1.0,
        horizon: int = HORIZON,
        step_s: float = 1.0 / RATE_HZ,
    ) -> None:
        self.kind, self.fault, self.noise, self.gain = kind, fault, noise, gain
        self.horizon, self.step_s = horizon, step_s
        self.resets = 0

    def load(self) -> None:
        """Nothing to load."""

    def reset(self) -> None:
        """Counted."""
        self.resets += 1

    def close(self) -> None:
        """Nothing to close."""

    def predict(self, observation: Observation) -> ActionChunk:
        """The rows that belong to the picture, a little wrong, with the fault."""
        row = row_of(observation.frames["primary"].image)
        assert observation.joints is not None
        np.testing.assert_allclose(observation.joints.position[:7], STATE_JOINTS[row], atol=1e-5)
        whole = recorded(self.kind)
        error = (
            self.noise
            * whole.std(axis=0)
            * np.random.default_rng(row).normal(size=(self.horizon, whole.shape[1]))
        )
        right = actions(self.kind)[MARGIN + row :][: self.horizon]
        error += (self.gain - 1.0) * (right - whole.mean(axis=0))
        error[:, -1] = 0.0
        asked = Asked(self.kind, row, error)
        rows = asked.rows() if self.fault is None else self.fault(asked)
        return ActionChunk(actions=rows, step_s=self.step_s, space=SPACES[self.kind])
