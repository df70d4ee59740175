"""What the stand-in takes, refuses, replaces and aborts, by the documentation of
joint_trajectory_controller.
"""

from __future__ import annotations

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from rn_driver_ros2control.standin import (
    GOAL_VIOLATED,
    PATH_VIOLATED,
    SUCCESSFUL,
    StandInController,
    Tolerances,
)
from rn_driver_ros2control.trajectory import to_duration

JOINTS = ("a", "b")
BOUNDS = Tolerances(path={"a": 0.1, "b": 0.1}, goal={"a": 0.01, "b": 0.01}, goal_time_s=0.5)


def trajectory(
    *points: tuple[float, list[float]], names=JOINTS, rest=False, stamp_s=0
) -> JointTrajectory:
    message = JointTrajectory(joint_names=list(names))
    message.header.stamp = Time(sec=stamp_s)
    for due_s, position in points:
        point = JointTrajectoryPoint(positions=position, time_from_start=to_duration(due_s))
        point.velocities = [0.0] * len(position) if rest else []
        message.points = [*message.points, point]
    return message


def controller(**options) -> StandInController:
    made = StandInController(JOINTS, np.zeros(2), **options)
    made.update(100.0)
    return made


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (JointTrajectory(), "Empty joint names"),
        (trajectory(), "Empty trajectory"),
        (trajectory((1.0, [1.0]), names=("a",)), "don't match"),
        (trajectory((1.0, [1.0, 1.0]), names=("a", "c")), "Incoming joint c"),
        (trajectory((1.0, [1.0])), "Mismatch"),
        (trajectory((1.0, [1.0, 1.0]), (1.0, [2.0, 2.0])), "strictly increasing"),
        (trajectory((1.0, [1.0, 1.0]), stamp_s=50), "ends in the past"),
    ],
)
def test_what_does_not_fit_is_refused(message, reason):
    assert reason in controller().refusal(message, 100.0)


def test_a_start_in_the_past_with_an_end_in_the_future_is_taken():
    assert controller().refusal(trajectory((60.0, [1.0, 1.0]), stamp_s=50), 100.0) == ""


def test_a_velocity_at_the_end_is_refused_unless_allowed():
    message = trajectory((1.0, [1.0, 1.0]), rest=True)
    message.points[0].velocities = [0.0, 0.2]
    assert "Velocity of last" in controller().refusal(message, 100.0)
    assert controller(allow_nonzero_end=True).refusal(message, 100.0) == ""


def test_positions_alone_are_linear_and_velocities_make_a_cubic():
    linear, cubic = controller(), controller()
    linear.take(trajectory((1.0, [1.0, -1.0])), 100.0)
    cubic.take(trajectory((1.0, [1.0, -1.0]), rest=True), 100.0)
    for made, quarter in ((linear, 0.25), (cubic, 3 * 0.25**2 - 2 * 0.25**3)):
        made.update(100.25)
        assert made.reference.tolist() == pytest.approx([quarter, -quarter])
        made.update(101.0)
        assert made.reference.tolist() == [1.0, -1.0]


def followed(made: StandInController, begin_s: float, end_s: float) -> np.ndarray:
    """Time, position and velocity of the first joint's reference, each millisecond (n, 3)."""
    told = []
    for now_s in np.arange(begin_s, end_s, 1e-3):
        made.update(now_s)
        told.append((now_s, made.reference[0], made.reference_velocity[0]))
    return np.array(told)


CHUNK = trajectory(*((0.05 * n, [0.01 * n, 0.0]) for n in range(1, 9)))


def test_upsampled_positions_are_one_motion_without_a_jump_of_velocity():
    made = controller(policy_frequency_hz=20.0)
    message = made.upsampled(CHUNK)
    assert made.refusal(message, 100.0) == ""
    made.take(message, 100.0)
    told = followed(made, 100.0, 100.45)
    for n in range(1, 9):
        at = int(np.argmin(np.abs(told[:, 0] - 100.0 - 0.05 * n)))
        assert told[at, 1] == pytest.approx(0.01 * n, abs=2e-4)
    assert np.abs(np.diff(told[:, 2])).max() < 0.02  # linear: 0.2 at the first row
    # between rows it is faster than the mean of 0.2: limits of velocity need that much room
    assert told[:, 2].max() == pytest.approx(0.2 * 1.37, abs=0.01)


def test_an_upsampled_chunk_goes_on_from_the_velocity_of_the_one_before():
    made = controller(policy_frequency_hz=20.0)
    made.take(made.upsampled(CHUNK), 100.0)
    before = followed(made, 100.0, 100.2)
    later = trajectory(*((0.05 * n, [0.04 + 0.01 * n, 0.0]) for n in range(1, 9)))
    made.take(made.upsampled(later), before[-1, 0])
    after = followed(made, before[-1, 0], 100.3)
    assert after[0, 2] == pytest.approx(before[-1, 2], abs=0.01)


def test_positions_without_times_come_at_the_frequency_of_the_policy():
    made = controller(policy_frequency_hz=10.0)
    message = made.upsampled(trajectory((0.0, [0.1, 0.0]), (0.0, [0.2, 0.0])))
    times_s = [p.time_from_start.sec + p.time_from_start.nanosec * 1e-9 for p in message.points]
    assert times_s == [0.1, 0.2]


@pytest.mark.parametrize(
    "message",
    [
        trajectory((1.0, [1.0, 1.0]), rest=True),
        trajectory((1.0, [1.0])),
        trajectory((1.0, [1.0, 1.0]), (0.5, [2.0, 2.0])),
        trajectory((1.0, [1.0, 1.0]), names=("a", "c")),
    ],
    ids=["velocities", "sizes", "times", "joints"],
)
def test_other_messages_are_not_upsampled(message):
    made = controller(policy_frequency_hz=20.0)
    assert made.upsampled(message) is message
    assert controller().upsampled(CHUNK) is CHUNK


def test_a_new_trajectory_replaces_the_one_before_from_where_the_joints_are():
    made = controller()
    made.take(trajectory((1.0, [1.0, 1.0])), 100.0)
    made.update(100.5)
    made.take(trajectory((1.0, [0.0, 0.0])), 100.5)
    made.update(101.0)
    assert made.reference.tolist() == pytest.approx([0.25, 0.25])


def test_the_end_within_its_tolerance_is_a_success_told_once():
    made = controller(tolerances=BOUNDS)
    made.take(trajectory((0.5, [1.0, 1.0])), 100.0)
    verdict = made.update(100.5)
    assert verdict is not None
    assert verdict.code == SUCCESSFUL
    assert made.update(101.0) is None


def test_a_blocked_joint_violates_the_path_and_the_controller_holds_where_it_is():
    made = controller(tolerances=BOUNDS)
    made.take(trajectory((1.0, [1.0, 0.0])), 100.0)
    made.blocked = True
    assert made.update(100.05) is None
    verdict = made.update(100.2)
    assert verdict is not None
    assert verdict.code == PATH_VIOLATED
    assert made.reference.tolist() == [0.0, 0.0]


def test_an_end_out_of_reach_is_aborted_after_the_goal_time():
    made = controller(tolerances=Tolerances(goal={"a": 0.01}, goal_time_s=0.5))
    made.take(trajectory((0.1, [1.0, 0.0])), 100.0)
    made.blocked = True
    assert made.update(100.4) is None
    verdict = made.update(100.7)
    assert verdict is not None
    assert verdict.code == GOAL_VIOLATED


def test_tolerances_of_a_goal_keep_replace_or_erase_the_defaults():
    asked = BOUNDS.with_goal({"a": 0.0, "b": -1.0}, {"a": 0.5}, 0.0)
    assert (asked.path["a"], asked.path["b"], asked.goal["a"], asked.goal_time_s) == (
        0.1,
        0.0,
        0.5,
        0.5,
    )


def test_an_inactive_controller_does_not_move():
    made = controller()
    made.active = False
    made.take(trajectory((0.1, [1.0, 1.0])), 100.0)
    made.update(101.0)
    assert made.measured.tolist() == [0.0, 0.0]
