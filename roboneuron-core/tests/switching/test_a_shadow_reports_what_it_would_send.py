"""What a module in shadow tells about itself, for the comparison with the module that works."""

from __future__ import annotations

import time

import numpy as np
import pytest

from roboneuron.contract import ACTION_FIELDS, ActionChunk, Hold, JointCommand, Pose
from roboneuron.modules.status import StatusWriter
from roboneuron.switching.handover import TimedHandover

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture
def shadow() -> TimedHandover:
    return TimedHandover(True, StatusWriter("fake/control"))


def command(position: float) -> JointCommand:
    return JointCommand(names=("a", "b"), position=np.array([position, 0.0]), duration_s=0.1)


def metrics(shadow: TimedHandover) -> dict[str, str]:
    return dict(shadow.status.report().metrics)


def test_the_first_action_of_a_chunk_is_told_as_numbers(shadow: TimedHandover) -> None:
    shadow.withhold(
        ActionChunk(actions=np.array([[0.01, 0, 0, 0, 0, -0.5, 1.0], [0] * 7]), step_s=0.1)
    )
    told = metrics(shadow)
    assert [float(told[f"shadow_action.{name}"]) for name in ACTION_FIELDS] == [
        0.01,
        0,
        0,
        0,
        0,
        -0.5,
        1.0,
    ]
    assert told["shadow_count"] == "1"


def test_two_answers_to_one_action_are_compared_in_either_order(shadow: TimedHandover) -> None:
    shadow.withhold(command(0.5))
    shadow.hear(command(0.52), time.monotonic())
    assert float(metrics(shadow)["shadow_difference"]) == pytest.approx(0.02)
    shadow.hear(command(0.6), time.monotonic())
    shadow.withhold(command(0.66))
    assert metrics(shadow)["shadow_compared"] == "2"
    assert float(metrics(shadow)["shadow_difference"]) == pytest.approx(0.04)


def test_a_command_of_another_time_is_not_compared(shadow: TimedHandover) -> None:
    shadow.withhold(command(0.5))
    shadow.hear(command(0.9), time.monotonic() - 1.0)
    assert "shadow_difference" not in metrics(shadow)


def test_a_refusal_is_told_in_words(shadow: TimedHandover) -> None:
    shadow.withhold(Hold(code="too_far", reason="0.3 m are too far."))
    assert metrics(shadow)["shadow_hold"] == "too_far: 0.3 m are too far."
    shadow.withhold(command(0.5))
    assert metrics(shadow)["shadow_hold"] == ""


def test_poses_of_one_joint_state_are_compared(shadow: TimedHandover) -> None:
    for stamp_ns in (1, 2, 3):
        shadow.withhold(
            Pose(
                position_m=np.array([0.1 * stamp_ns, 0, 0]),
                quaternion_xyzw=UPRIGHT,
                stamp_ns=stamp_ns,
            )
        )
    shadow.hear(Pose(position_m=np.array([0.0, 0, 0]), quaternion_xyzw=UPRIGHT, stamp_ns=9), 0.0)
    assert "shadow_tcp_difference" not in metrics(shadow)
    shadow.hear(Pose(position_m=np.array([0.2, 0.03, 0]), quaternion_xyzw=UPRIGHT, stamp_ns=2), 0.0)
    assert float(metrics(shadow)["shadow_tcp_difference"]) == pytest.approx(0.03)


def test_first_and_newest_output_are_told(shadow: TimedHandover) -> None:
    shadow.note_sent("pose")
    first = metrics(shadow)["first_sent_ns.pose"]
    assert metrics(shadow)["last_sent_ns.pose"] == first
    assert shadow.status.changed.is_set()
    shadow.note_sent("pose")
    assert metrics(shadow)["first_sent_ns.pose"] == first
    assert int(metrics(shadow)["last_sent_ns.pose"]) >= int(first)
