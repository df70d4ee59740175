"""A served FR3 with a loaded policy: direct tools move it while the policy has no instruction, the
later request is refused, and the hand-over does not jump.

Judged by its measured joints, by the truth of the simulation.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from cancelled_arm import INSTRUCTION, Arm

from rn_testing.waiting import wait_until
from roboneuron.ros.environment import prepare_environment

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
JUMP_RAD_S = 2.0
"""A joint of the FR3 is allowed 2.6 rad/s; the motions here ask for a tenth of it. A jump to an old
posture, of 0.5 rad within a control period of 0.02 s, would be 25 rad/s.
"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arm]:
    folder = tmp_path_factory.mktemp("arm")
    prepare_environment(folder / "ros")
    made = Arm(folder)
    made.use("http", "2025-11-25", "notification")
    made.steward.call("start_inference", {})
    yield made
    made.close()


def test_direct_tools_move_the_arm_beside_an_idle_policy(arm: Arm) -> None:
    joints = {"fr3_joint1": 0.4}
    assert arm.steward.call("move_joints", {"positions": joints})["error"] < 0.01
    assert arm.steward.call("move_ee", {"dz_m": -0.03})["error_m"] < 0.004
    assert arm.phase("inference") == "running"


def test_an_instruction_is_refused_while_a_tool_moves_the_arm(arm: Arm) -> None:
    client = arm.use("http", "2025-11-25", "notification")
    client.begin("move_joints", {"positions": {"fr3_joint1": -0.6}, "duration_s": 6})
    wait_until(client.has_progress, 30.0, "the arm is moved")
    for tool in ("set_instruction", "run_task"):
        error = arm.steward.failure(tool, {"instruction": INSTRUCTION})
        assert error["rule"] == "ownership"
        assert "move_joints" in error["message"]
        assert "stop_motion" in error["hint"]
    wait_until(client.has_answered, 30.0, "the earlier request goes on to its end")
    assert '"isError":false' in client.said().replace(" ", "")
    client.leave_call()


def test_a_tool_is_refused_while_the_policy_has_an_instruction_and_nothing_jumps(arm: Arm) -> None:
    wait_until(arm.rests, 20.0, "rest")
    arm.steward.call("move_joints", {"positions": {"fr3_joint1": -0.4}})
    arm.steward.call("set_instruction", {"instruction": INSTRUCTION})
    wait_until(arm.moves, 30.0, "the policy moves the arm")
    assert arm.fastest_rad_s() < JUMP_RAD_S, "it goes on from the measured posture"
    error = arm.steward.failure("move_joints", {"positions": {"fr3_joint1": 0.4}})
    assert error["rule"] == "ownership"
    assert INSTRUCTION in error["message"]
    arm.steward.call("stop_motion", {})
    assert arm.steward.call("move_joints", {"positions": {"fr3_joint1": 0.4}})["error"] < 0.01
    assert arm.fastest_rad_s() < JUMP_RAD_S


def test_a_task_leaves_no_instruction_behind(arm: Arm) -> None:
    wait_until(arm.rests, 20.0, "rest")
    task = arm.steward.call("run_task", {"instruction": INSTRUCTION, "max_s": 60})
    assert task["outcome"] == "succeeded", "a pick is judged by itself"
    assert not arm.module("inference")["instruction"]
    assert arm.steward.call("move_ee", {"dz_m": 0.05})["holding"] is True
    assert arm.phase("inference") == "running"
