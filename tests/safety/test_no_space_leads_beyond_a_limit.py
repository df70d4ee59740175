"""Random and hostile chunks of every control space, from agreement to command: no command breaks a
limit, as checked by `MotionJudge`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_loop import Clock, ControlLoop
from motion_judge import ArmFacts, MotionJudge

from rn_controller_urdf.plugin import roboneuron_controllers
from rn_robot_fr3 import limits as fr3
from rn_robot_fr3.profile import (
    FINGER_LINKS,
    HOME_RAD,
    TABLE_LOWER_M,
    TABLE_UPPER_M,
    WORKSPACE_LOWER_M,
    WORKSPACE_UPPER_M,
    profile,
)
from roboneuron.contract import (
    SPACE_KINDS,
    ActionChunk,
    ControlSpace,
    RobotProfile,
    robot_space,
)
from roboneuron.errors import RoboNeuronError
from roboneuron.modules import holding
from roboneuron.modules.control import module as control_module
from roboneuron.modules.inference.agreement import SpaceAgreement, agree
from roboneuron.ros.messages import to_action_message

F64 = np.ndarray
MIN_HEIGHT_M = 0.06
ZONES = {"vase": ((0.40, -0.30, -0.1), (0.60, -0.08, 0.42))}
VELOCITY, ACCELERATION = 0.8, 0.9
"""Configured shares of the joint limits."""
CONFIG = f"""
[robot]
name = "fr3"
[control]
controller = "urdf"
action_timeout_s = 0.5
[limits]
velocity_fraction = {VELOCITY}
acceleration_fraction = {ACCELERATION}
min_height_m = {MIN_HEIGHT_M}
zones = [{{ name = "vase", lower_m = [0.40, -0.30, -0.1], upper_m = [0.60, -0.08, 0.42] }}]
"""
SCALED = "".join(
    f'on_{name} = "scale"\n'
    for name in ("position", "workspace", "zone", "height", "collision", "step", "singularity")
)
"""Shorten instead of hold: other code, same limits."""
FACTS = ArmFacts(
    urdf=profile().urdf,
    base_link="fr3_link0",
    tcp_link="fr3_hand_tcp",
    joints=fr3.ARM_JOINTS,
    lower=np.array(fr3.LOWER_RAD),
    upper=np.array(fr3.UPPER_RAD),
    velocity=np.array(fr3.VELOCITY_RAD_S) * VELOCITY,
    acceleration=np.array(fr3.ACCELERATION_RAD_S2) * ACCELERATION,
    velocity_bounds=fr3.velocity_bounds,
    finger=(fr3.FINGER_JOINT, 0.0, fr3.FINGER_OPEN_M),
    max_speed_m_s=0.5,
    max_turn_rad_s=2.5,
    workspace=(WORKSPACE_LOWER_M, WORKSPACE_UPPER_M),
    min_height_m=MIN_HEIGHT_M,
    zones=tuple(ZONES.values()),
    obstacles={"table": (TABLE_LOWER_M, TABLE_UPPER_M)},
    min_distance_m=0.010,
    tool_links=FINGER_LINKS,
    touching=(
        frozenset(("fr3_link7", "fr3_hand")),
        frozenset(("fr3_leftfinger", "fr3_rightfinger")),
    ),
    home=np.array(HOME_RAD),
)


@dataclass(frozen=True)
class Subject:
    """A robot under test.

    Attributes:
        config: roboneuron.toml, without the reactions.
        facts: facts of each of its arms.
        make_profile: creates the robot's profile.
    """

    config: str
    facts: ArmFacts
    make_profile: Any


SUBJECTS = {"fr3": Subject(CONFIG, FACTS, profile)}
KINDS = roboneuron_controllers()[0].spaces


class HostilePolicy:
    """Chunks of one space: continued motion in one direction, jumps, and damaged values."""

    def __init__(self, space: ControlSpace, judge: MotionJudge, rng: np.random.Generator) -> None:
        self._space, self._judge, self._rng = space, judge, rng
        self._direction: F64 = np.zeros(7)
        self._left = 0

    def chunk(self, position: F64, step_s: float) -> ActionChunk:
        """The next chunk, relative to the arm's position. Raises as `ActionChunk`."""
        rng = self._rng
        if self._left <= 0:
            self._left = int(rng.integers(1, 30))
            size = rng.choice([0.05, 0.3, 1.0, 4.0])
            self._direction = rng.normal(size=7) * size * rng.choice([0.0, 1.0], 7, p=[0.4, 0.6])
        self._left -= 1
        rows = np.array([self._row(position, step_s, i) for i in range(rng.integers(1, 4))])
        if rng.random() < 0.05:
            self._damage(rows)
        return ActionChunk(actions=rows, step_s=step_s, space=self._space)

    def _row(self, position: F64, step_s: float, index: int) -> F64:
        rng, kind = self._rng, self._space.kind
        opening = float(rng.choice([0.0, 0.3, 1.0]))
        motion = self._direction + rng.normal(size=7) * 0.1
        ahead = motion * step_s * (index + 1)
        named = dict(zip(self._judge.facts.joints, position, strict=True))
        if kind == "joint_velocity":
            numbers = dict(zip(named, motion, strict=True))
        elif kind == "joint_delta":
            numbers = dict(zip(named, ahead, strict=True))
        elif kind == "joint_position":
            place = position + ahead
            if rng.random() < 0.03:
                place = rng.uniform(self._judge.facts.lower, self._judge.facts.upper)
            numbers = dict(zip(named, place, strict=True))
        else:
            numbers = self._tcp_row(position, motion * 0.3, step_s * (index + 1), step_s)
        numbers["gripper_open"] = opening
        return np.array([numbers[key] for key in self._space.keys])

    def _tcp_row(
        self, position: F64, motion: F64, ahead_s: float, step_s: float
    ) -> dict[str, float]:
        if self._space.kind == "ee_delta":
            names = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")
            return dict(zip(names, motion[:6] * step_s, strict=True))
        import pinocchio

        pose = self._judge.pose(position)
        point = pose.translation + motion[:3] * ahead_s
        rotation = pinocchio.exp3(motion[3:6] * ahead_s) @ pose.rotation
        quaternion = pinocchio.Quaternion(rotation).coeffs() * self._rng.choice([-1.0, 1.0, 1.05])
        names = ("x", "y", "z", "qx", "qy", "qz", "qw")
        return dict(zip(names, [*point, *quaternion], strict=True))

    def _damage(self, rows: F64) -> None:
        place = self._rng.integers(0, rows.shape[1])
        rows[-1, place] = self._rng.choice([np.nan, np.inf, -np.inf, 1e300, -1e9, 1.2, 100.0])


def shuffled(space: ControlSpace, rng: np.random.Generator) -> ControlSpace:
    """The same channels in another order, as another policy might yield them."""
    if space.kind == "ee_delta":
        return space
    order = rng.permutation(space.size)
    return replace(space, channels=tuple(space.channels[i] for i in order))


def foreign_message(space: ControlSpace, rng: np.random.Generator) -> Any:
    """A message that another publisher than the policy might send."""
    size = int(rng.choice([space.size, space.size, 7, 14, 0]))
    message = to_action_message(rng.normal(size=size), space)
    label = message.layout.dim[0].label
    message.layout.dim[0].label = str(
        rng.choice(
            [label, "", "torque:a", "ee_delta_base@5", f"{label},left/a", "joint_position:x"]
        )
    )
    return message


def drive(
    loop: ControlLoop, kind: str, robot: RobotProfile, chunks: int, rng: np.random.Generator
) -> Counter[str]:
    """Run hostile policies; return the results of their chunks."""
    outcomes: Counter[str] = Counter()
    while outcomes["chunks"] < chunks:
        rate_hz = float(rng.choice([5.0, 15.0, 30.0]))
        declared = shuffled(robot_space(kind, robot, rate_hz), rng)
        agreement = agree(declared, robot, KINDS, backend="hostile", controller="urdf")
        policy = HostilePolicy(declared, loop.judge, rng)
        for _ in range(min(100, chunks)):
            outcomes["chunks"] += 1
            seen = loop.joints()
            try:
                chunk = policy.chunk(loop.judge.place(loop.clock.now_s), 1.0 / rate_hz)
                chunk = agreement.convert(chunk, seen)
            except RoboNeuronError:
                outcomes["refused"] += 1
                loop.go(1.0 / rate_hz)
                continue
            play(loop, agreement, chunk, rng)
        loop.go(0.6)
        loop.go(0.6)
    return outcomes


def play(
    loop: ControlLoop, agreement: SpaceAgreement, chunk: ActionChunk, rng: np.random.Generator
) -> None:
    """Send the rows of a chunk in time, but with arrivals that are early, late, bunched or lost."""
    for row in chunk.actions:
        if rng.random() < 0.02:
            loop.receive(foreign_message(agreement.executed, rng))
        if rng.random() > 0.02:
            age_s = float(rng.choice([0.0, 0.003, 0.02]))
            loop.receive(to_action_message(row, agreement.executed), age_s)
        late = float(rng.choice([0.0, 1.0, 0.3, 1.5], p=[0.1, 0.6, 0.2, 0.1]))
        # a third exactly at the end of the command, the others before and after
        jitter = float(rng.choice([1.0, rng.uniform(0.95, 1.05)], p=[0.3, 0.7]))
        loop.go(max(0.001, chunk.step_s * late * jitter))


@pytest.fixture
def make_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return a function that makes an active control of a robot with those reactions."""
    clock = Clock()
    for module in (control_module, holding):
        monkeypatch.setattr(module, "time", clock)
    made: list[ControlLoop] = []

    def make(subject: Subject, reactions: str) -> ControlLoop:
        judge = MotionJudge(subject.facts)
        made.append(ControlLoop(subject.config + reactions, judge, tmp_path, clock))
        return made[-1]

    yield make
    for loop in made:
        loop.close()


@pytest.mark.parametrize(
    "chunks",
    [
        50,
        pytest.param(100, marks=pytest.mark.exhaustive),
        pytest.param(10_000, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("reactions", ["", SCALED], ids=["hold", "scale"])
@pytest.mark.parametrize("kind", SPACE_KINDS)
@pytest.mark.parametrize("robot", SUBJECTS)
def test_no_chunk_of_any_space_breaks_a_limit(
    make_loop: Any, robot: str, kind: str, reactions: str, chunks: int
) -> None:
    subject = SUBJECTS[robot]
    loop = make_loop(subject, reactions)
    rng = np.random.default_rng([SPACE_KINDS.index(kind), bool(reactions)])
    outcomes = drive(loop, kind, subject.make_profile(), chunks, rng)
    assert loop.judge.broken == {}
    assert loop.changed == [], "control keeps what the robot module limits"
    # the chunks were hostile, and the arm moved nevertheless
    assert loop.commands > 0.4 * chunks
    acted = loop.acted()
    assert "acceleration" in acted
    if chunks >= 100:
        assert "malformed" in loop.drops()
    if chunks >= 10_000:
        assert outcomes["refused"] > 100
        assert {"velocity", "speed"} <= acted
        assert len(acted) >= 6


TELLING = (2, 16)
"""Seeds with which all limits are broken; tried first."""


def test_the_judge_sees_what_the_limits_prevent(
    make_loop: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same chunks with a gate that permits everything."""
    prevented = {"position", "velocity", "braking", "acceleration", "speed"}
    prevented |= {"workspace", "height", "zone", "collision"}
    broken: set[str] = set()
    for seed in sorted(range(4 * len(SPACE_KINDS)), key=lambda seed: seed not in TELLING):
        kind = SPACE_KINDS[seed % len(SPACE_KINDS)]
        loop = make_loop(SUBJECTS["fr3"], "")
        monkeypatch.setattr(loop.control, "_limit", lambda command, joints, now_s: command)
        drive(loop, kind, profile(), 100, np.random.default_rng(seed))
        broken |= set(loop.judge.broken)
        if broken >= prevented:
            return
    pytest.fail(f"never broken: {prevented - broken}")
