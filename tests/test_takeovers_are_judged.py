"""The judge of benchmarks/bench_takeovers.py detects faults of a handover."""

from __future__ import annotations

import sys
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from takeover_judge import Onlooker, faults_of
from touched_things import touched

sys.path.pop(0)

from rn_robot_fr3.simulation import ArmSimulation
from rn_simulation.scene_state import SceneState
from rn_standard.teleoperation.rows import Acting
from roboneuron import JointLimits

PERIOD_NS = 10_000_000
FAST, STILL = 0.5, 0.0


class Seen(Onlooker):
    """An observer with given observations: one joint, by its velocity every 10 ms."""

    def __init__(self, velocities: list[float]) -> None:
        one = np.ones(1)
        self._limits = JointLimits(
            lower=-one, upper=one, velocity=one, acceleration=10.0 * one, effort=one
        )
        positions = np.cumsum(velocities) * PERIOD_NS / 1e9
        self.joints = [
            (number * PERIOD_NS, np.array([position]), np.array([velocity]))
            for number, (position, velocity) in enumerate(zip(positions, velocities, strict=True))
        ]
        self.acting, self.actions, self.scenes = [], [], deque()

    def tell(self, who: str, *periods: int) -> None:
        acted = Acting(who=who, session="", number=0, share=1.0, limits="", note="")
        self.acting += [(period * PERIOD_NS, acted) for period in periods]


def test_a_jump_is_a_step_of_velocity_and_too_much_acceleration() -> None:
    smooth = Seen([FAST * min(1.0, n / 50) for n in range(100)]).motion(0, 10**9)
    jump = Seen([STILL] * 50 + [FAST] * 50).motion(0, 10**9)
    assert smooth is not None
    assert jump is not None
    assert jump.step_rad_s == pytest.approx(FAST)
    assert smooth.step_rad_s == pytest.approx(FAST / 25)
    assert (smooth.acceleration < 0.2, jump.acceleration > 2.0) == (True, True)
    assert jump.jerk_rad_s3 > 20 * smooth.jerk_rad_s3


def test_places_beyond_a_limit_and_speeds_are_seen() -> None:
    found = Seen([0.9] * 130).motion(0, 2 * 10**9)
    assert found is not None
    assert found.outside_rad == pytest.approx(0.9 * 1.29 - 1.0, abs=0.01)
    assert found.velocity == pytest.approx(0.9)


def test_rest_is_after_the_last_motion() -> None:
    seen = Seen([FAST] * 30 + [STILL] * 100)
    assert seen.rest_s(20 * PERIOD_NS, 100 * PERIOD_NS) == pytest.approx(0.09)
    assert seen.rest_s(40 * PERIOD_NS, 100 * PERIOD_NS) == 0.0


def test_late_motion_is_told_with_its_joint_and_way() -> None:
    seen = Seen([FAST] * 30 + [STILL] * 30 + [FAST / 10] * 5 + [STILL] * 30)
    found = seen.late_motion(29 * PERIOD_NS, 90 * PERIOD_NS)
    assert (found["joint"], found["samples"], found["touched"]) == (0, 5, [])
    assert found["speed_rad_s"] == pytest.approx(FAST / 10)
    assert found["way_rad"] == pytest.approx(5 * FAST / 10 * PERIOD_NS / 1e9)
    assert (found["from_s"], found["to_s"]) == pytest.approx((0.31, 0.35))
    assert seen.late_motion(66 * PERIOD_NS, 90 * PERIOD_NS) == {}


def test_a_cube_between_the_fingers_is_touched_and_the_base_on_its_table_is_not() -> None:
    with ArmSimulation(seed=1, colours=("red", "green"), engine="pybullet") as cell:
        poses = np.array([[*at, *turn] for at, turn in cell.world.cube_poses().values()])
        at_tcp = poses.copy()
        at_tcp[0, :3] = cell.world.T_base_tcp()[:3, 3]
        joints = cell.joint_positions()
        joints[7:] = 0.5 * cell.scene[0].edge_m

        def scene(cubes: Any) -> SceneState:
            return SceneState(
                robot="fr3",
                engine="pybullet",
                seed=1,
                cubes=tuple((cube.name, cube.edge_m) for cube in cell.scene),
                joints=joints,
                cube_poses=cubes,
                stamp_ns=0,
            )

        assert touched([scene(poses)]) == set()
        assert touched([scene(poses), scene(at_tcp)]) == {"red"}


def test_the_policy_goes_on_by_an_action_from_after_the_release() -> None:
    seen = Seen([FAST])
    seen.actions = [5 * PERIOD_NS]
    seen.tell("person", 10, 12)
    seen.tell("policy", 14, 16)  # the release, and the messages sent before it
    assert seen.went_on_s(13 * PERIOD_NS) is None
    seen.actions.append(18 * PERIOD_NS)
    seen.tell("policy", 19)
    assert seen.went_on_s(13 * PERIOD_NS) == pytest.approx((0.06, 0.01))
    assert seen.who(9 * PERIOD_NS, 13 * PERIOD_NS) == {"person"}


GOOD = {"step_rad_s": 0.1, "acceleration": 0.9, "jerk_rad_s3": 1.0, "velocity": 0.5}
SENT = {"all": {"count": 9, "acceleration": 1.0, "step_rad_s": 0.2, "velocity": 0.4}}
TAKEN = {
    "sent": SENT,
    "unknown": 0,
    "part": "takeovers",
    "mode": "person",
    "refused": "",
    "who": ["nobody", "person"],
    "went_on": [0.3, 0.01],
    "held_up_s": 0.004,
    "all": {**GOOD, "outside_rad": 0.0},
}
LOST = {
    "sent": SENT,
    "unknown": 0,
    "part": "lost",
    "way": "killed",
    "rest_s": 0.15,
    "commanded_s": 0.08,
    "held_up_s": 0.004,
    "needs_start": "the lead was lost",
    "goes_on": False,
    "all": {**GOOD, "outside_rad": 0.0},
}


@pytest.mark.parametrize(
    "row",
    [
        TAKEN,
        LOST,
        {**LOST, "way": "released", "goes_on": True},
        {**LOST, "rest_s": 0.5, "late_motion": {"touched": ["red"]}},
    ],
)
def test_what_is_right_has_no_fault(row: dict[str, Any]) -> None:
    assert faults_of(row) == []


@pytest.mark.parametrize(
    "row",
    [
        {**TAKEN, "who": ["person", "policy"]},
        {**TAKEN, "mode": "blend"},
        {**TAKEN, "went_on": None},
        {**TAKEN, "went_on": [0.3, 0.09]},
        {**TAKEN, "refused": "no"},
        {**TAKEN, "sent": {"all": {**SENT["all"], "acceleration": 1.03}}},
        {**LOST, "held_up_s": 0.5, "sent": {"all": {**SENT["all"], "velocity": 1.03}}},
        {**LOST, "sent": {"all": None}},
        {**TAKEN, "unknown": 1},
        {**TAKEN, "all": {**TAKEN["all"], "outside_rad": 0.01}},
        {**TAKEN, "all": None},
        {**LOST, "rest_s": 0.21},
        {**LOST, "rest_s": 0.5, "late_motion": {"touched": []}},
        {**LOST, "needs_start": ""},
        {**LOST, "needs_start": "", "rest_s": 0.3, "held_up_s": 0.5},
        {**TAKEN, "who": ["person", "policy"], "held_up_s": 0.5},
        {**LOST, "way": "released"},
    ],
)
def test_each_fault_is_told(row: dict[str, Any]) -> None:
    assert len(faults_of(row)) == 1
