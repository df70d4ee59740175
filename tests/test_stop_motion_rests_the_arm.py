"""The simulated FR3, in both engines, and a pair of them are at rest after stop_motion, whatever
moves them, and do not move again until they are asked to.

Judged by the measured joints, which are the truth of the simulation. That the arm rests within
0.3 s of the call is judged in the timing lane, where nothing runs beside it; fingers end their
travel.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import cycle
from typing import Any

import pytest
from cancelled_arm import INSTRUCTION, MOTIONS, NEVER, Arm

from rn_testing.waiting import holds_within, wait_until
from roboneuron.config import default_text
from roboneuron.ros.environment import prepare_environment

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
REST_S = 0.3
LOADED_REST_S = 1.0
"""On a busy machine; each of the motions would go on for longer."""
QUIET_S = 1.0
FINGERS_S = 1.5
"""Fingers end the travel that they are on, so that nothing is dropped."""
ENGINE = '[plugins.fr3]\nengine = "{}"\n'
PAIR = """
[robot]
name = "fr3-pair"
[perception]
source = "fr3-pair-sim-camera"
[inference]
backend = "servo-pair"
[control]
controller = "urdf"
"""
ROBOTS = {
    "pybullet": (default_text() + ENGINE.format("pybullet"), "fr3"),
    "mujoco": (default_text() + ENGINE.format("mujoco"), "fr3"),
    "pair": (PAIR, "fr3_pair"),
}
"""Configuration and namespace of each simulated robot."""
OF_ONE_ARM = {
    "move_joints": "move_joints of 'fr3'",
    "trajectory": "",
    "sequence": "publish_joint_trajectory_sequence of 'fr3'",
    "move_ee": "move_ee of 'fr3'",
    "posture": "'fr3'",
    "gesture": "'fr3'",
    "straight": "'fr3'",
    "pick": "'fr3'",
    "place": "'fr3'",
    "push": "'fr3'",
    "run_task": f"run_task {INSTRUCTION!r}",
    "set_instruction": f"the policy with the instruction {INSTRUCTION!r}",
    "lead_arm": "lead_arm of 'fr3'",
}
"""What moves the arm, and how the answer names it. A single trajectory is sent at once: the robot
carries it out after its call has ended, and no call is named.
"""
OF_TWO_ARMS = {
    "both": "move_joints of 'fr3-pair'",
    "one": "move_ee of 'fr3-pair'",
    "hand_over": "run_task",
}
CELLS = [
    *((engine, kind) for engine in ("pybullet", "mujoco") for kind in OF_ONE_ARM),
    *(("pair", kind) for kind in OF_TWO_ARMS),
]
TURNS = ("left_fr3_joint1", "right_fr3_joint1")
CALLS = {
    **{kind: MOTIONS[kind] for kind in OF_ONE_ARM if kind in MOTIONS},
    "gesture": cycle([("move_to", {"name": "wave"})]),
    "both": cycle(
        ("move_joints", {"positions": dict.fromkeys(TURNS, one), "duration_s": 6})
        for one in (0.6, -0.6)
    ),
    "one": cycle(("move_ee", {"arm": "left", "dz_m": one, "duration_s": 5}) for one in (0.1, -0.1)),
    "hand_over": cycle(
        [("run_task", {"instruction": "hand over the red cube", "until": NEVER, "max_s": 60})]
    ),
}


def _lane(robot: str, kind: str) -> Any:
    """A cell: in the default lane those of one engine that move in different ways."""
    more = robot != "pybullet" or kind in ("gesture", "straight", "pick", "place", "push")
    marks = [pytest.mark.exhaustive] if more else []
    return pytest.param(robot, kind, marks=marks, id=f"{robot}-{kind}")


@pytest.fixture(scope="module")
def arm(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arm]:
    folder = tmp_path_factory.mktemp("arm")
    prepare_environment(folder / "ros")
    made = Arm(folder, *ROBOTS[request.param], label=request.param)
    yield made
    made.close()


@pytest.mark.parametrize(("arm", "kind"), [_lane(*cell) for cell in CELLS], indirect=["arm"])
def test_the_arm_rests_and_stays_at_rest(arm: Arm, kind: str) -> None:
    named = (OF_ONE_ARM | OF_TWO_ARMS)[kind]
    for _ in range(3):
        answer = stopped_while_it_moves(arm, kind)
        if answer["stopped"] or not named:
            break  # else a busy machine ended the motion before the stop
    assert answer["at_rest"] is True
    assert any(named in one for one in answer["stopped"]) or not named
    assert not arm.steward.call("get_status", {})["emergency_stop"]


@pytest.mark.timing
@pytest.mark.parametrize(("arm", "kind"), CELLS, indirect=["arm"])
def test_the_arm_rests_within_0_3_s(arm: Arm, kind: str) -> None:
    stopped_while_it_moves(arm, kind, within_s=REST_S)


def stopped_while_it_moves(
    arm: Arm, kind: str, *, within_s: float = LOADED_REST_S
) -> dict[str, Any]:
    """Start a motion of a kind, stop it, judge the rest; return what stop_motion answered."""
    client = arm.use("http", "2025-11-25", "notification", kind)
    arm.prepare("posture" if kind == "gesture" else kind)
    if kind == "set_instruction":
        client.begin(kind, {"instruction": INSTRUCTION})
    elif kind == "lead_arm":
        client.begin(kind, {"source": "twist-topic"})
        wait_until(client.has_answered, 30.0, "the lead begins")
        arm.push_until_it_moves()
    else:
        client.begin(*next(CALLS[kind]))
    try:
        assert holds_within(lambda: arm.moves(fingers=False), 30.0), (
            f"{kind} moves nothing: {client.said()[-2000:]} {arm.module('control')}"
        )
        since_s = time.monotonic()
        answer: dict[str, Any] = arm.steward.call("stop_motion", {})
        wait_until(arm.rests, 5.0, "rest")
        took_s, all_s = (arm.rested_after_s(since_s, fingers=counts) for counts in (False, True))
        told_s = answer["took_s"]
        print(f"{arm.label} {kind}: arm {took_s:.3f} s, fingers {all_s:.3f} s, answer {told_s} s")
        assert not holds_within(arm.moves, QUIET_S), "it moves again"
        assert took_s < within_s
        assert all_s < FINGERS_S
        return answer
    finally:
        arm.push(False)
        client.leave_call()
