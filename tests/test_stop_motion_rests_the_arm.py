"""The simulated FR3 is at rest after stop_motion, whatever moves it, and does not move again until
it is asked to.

Judged by its measured joints, by the truth of the simulation. That it rests within 0.3 s is judged
in the timing lane, where nothing runs beside it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest
from cancelled_arm import INSTRUCTION, MOTIONS, Arm

from rn_testing.waiting import holds_within, wait_until
from roboneuron.ros.environment import prepare_environment

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
REST_S = 0.3
LOADED_REST_S = 1.0
"""On a busy machine; each of the motions would go on for longer."""
QUIET_S = 1.0
KINDS = {
    "move_joints": "move_joints of 'fr3'",
    "trajectory": "",
    "sequence": "publish_joint_trajectory_sequence of 'fr3'",
    "move_ee": "move_ee of 'fr3'",
    "posture": "'fr3'",
    "run_task": f"run_task {INSTRUCTION!r}",
    "set_instruction": f"the policy with the instruction {INSTRUCTION!r}",
    "lead_arm": "lead_arm of 'fr3'",
}
"""What moves the arm, and how the answer names it. A single trajectory is sent at once: the robot
carries it out after its call has ended, and no call is named.
"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arm]:
    folder = tmp_path_factory.mktemp("arm")
    prepare_environment(folder / "ros")
    made = Arm(folder)
    yield made
    made.close()


@pytest.mark.parametrize("kind", KINDS)
def test_the_arm_rests_and_stays_at_rest(arm: Arm, kind: str) -> None:
    for _ in range(3):
        answer = stopped_while_it_moves(arm, kind)
        if answer["stopped"] or not KINDS[kind]:
            break  # else a busy machine ended the motion before the stop
    assert answer["at_rest"] is True
    assert any(KINDS[kind] in one for one in answer["stopped"]) or not KINDS[kind]
    assert not arm.steward.call("get_status", {})["emergency_stop"]


@pytest.mark.timing
@pytest.mark.parametrize("kind", KINDS)
def test_the_arm_rests_within_0_3_s(arm: Arm, kind: str) -> None:
    stopped_while_it_moves(arm, kind, within_s=REST_S)


def stopped_while_it_moves(
    arm: Arm, kind: str, *, within_s: float = LOADED_REST_S
) -> dict[str, Any]:
    """Start a motion of a kind, stop it, judge the rest; return what stop_motion answered."""
    client = arm.use("http", "2025-11-25", "notification", kind)
    arm.prepare(kind)
    if kind == "set_instruction":
        client.begin(kind, {"instruction": INSTRUCTION})
    elif kind == "lead_arm":
        client.begin(kind, {"source": "twist-topic"})
        wait_until(client.has_answered, 30.0, "the lead begins")
        arm.push_until_it_moves()
    else:
        client.begin(*next(MOTIONS[kind]))
    try:
        assert holds_within(arm.moves, 30.0), (
            f"{kind} moves nothing: {client.said()[-2000:]} {arm.module('control')}"
        )
        since_s = time.monotonic()
        answer: dict[str, Any] = arm.steward.call("stop_motion", {})
        wait_until(arm.rests, 5.0, "rest")
        took_s = arm.rested_after_s(since_s)
        print(f"{kind}: at rest after {took_s:.3f} s, answered {answer['took_s']:.3f} s")
        assert not holds_within(arm.moves, QUIET_S), "it moves again"
        assert took_s < within_s
        return answer
    finally:
        arm.push(False)
        client.leave_call()
