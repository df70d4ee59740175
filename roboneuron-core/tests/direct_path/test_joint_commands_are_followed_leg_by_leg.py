"""The legs that a joint command makes, and the first one that the joints could not follow."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import JointSample
from roboneuron.direct_path.fields import load_type
from roboneuron.direct_path.joint_messages import joint_commands
from roboneuron.errors import RefusedError
from roboneuron.gate.motion import joint_space
from roboneuron.gate.motion.driver_limits import MOST_POINTS
from roboneuron.gate.motion.joint_paths import check_joints

Limit = joint_space.JointLimit
LIMITS = {
    "a": Limit(lower=-1.0, upper=1.0, velocity=2.0, acceleration=10.0, effort=5.0),
    "b": Limit(lower=-9.0, upper=9.0, velocity=2.0, acceleration=10.0),
}
FREE = {"a": Limit(velocity=2.0)}
"""Nothing but how fast it may be."""
HERE = JointSample(names=("b", "a"), position=np.array([0.25, 0.5]))
ZERO = JointSample(names=("a", "b"), position=np.zeros(2))


def point(at_s: float, *positions: float, **values: list[float]) -> Any:
    seconds = math.floor(at_s)
    made = load_type("trajectory_msgs/msg/JointTrajectoryPoint")(positions=list(positions))
    made.time_from_start.sec = seconds
    made.time_from_start.nanosec = round((at_s - seconds) * 1e9)
    for name, numbers in values.items():
        setattr(made, name, numbers)
    return made


def trajectory(*points: Any, names: tuple[str, ...] = ("a",)) -> Any:
    kind = load_type("trajectory_msgs/msg/JointTrajectory")
    return kind(joint_names=list(names), points=list(points))


def state(*names: str, **values: list[float]) -> Any:
    return load_type("sensor_msgs/msg/JointState")(name=list(names), **values)


def refusal(
    *messages: Any, joints: JointSample | None = ZERO, durations_s: Any = (),
    limits: Mapping[str, Limit] = LIMITS,
) -> str:  # fmt: skip
    """What is said of commands that the joints cannot follow."""
    with pytest.raises(RefusedError) as caught:
        check_joints(limits, messages, joints, durations_s)
    return caught.value.message


# Commands inside of other messages


class Goal:
    """A goal that holds a trajectory, and lists of whatever there is."""

    __module__ = "test_msgs.action._goal"

    def __init__(self, **values: Any) -> None:
        self.__dict__.update(values)

    def get_fields_and_field_types(self) -> dict[str, str]:
        return dict.fromkeys(self.__dict__, "any")


def test_joint_commands_are_found_at_any_depth() -> None:
    first, second, third = state("a"), trajectory(), state("b")
    inner = Goal(number=1.0, command=second, words=["left", "right"])
    goal = Goal(name="go", first=first, many=[inner, third], pair=(Goal(),), nothing=[])
    assert list(joint_commands(goal)) == [first, second, third]
    assert list(joint_commands(first)) == [first]
    assert list(joint_commands(Goal(number=1))) == []
    assert list(joint_commands(load_type("geometry_msgs/msg/Twist")())) == []


# Trajectories


def test_each_point_of_a_trajectory_is_a_leg() -> None:
    first, second = check_joints(
        LIMITS,
        [
            trajectory(
                point(1.5, 0.6, 0.3, velocities=[0.1, 0.2]),
                point(2.75, 0.7, 0.4),
                names=("a", "b"),
            )
        ],
        HERE,
    )
    assert (first.names, first.position.tolist(), first.duration_s) == (("a", "b"), [0.6, 0.3], 1.5)
    assert first.velocity is not None
    assert first.velocity.tolist() == [0.1, 0.2]
    assert (second.position.tolist(), second.duration_s, second.velocity) == (
        [0.7, 0.4],
        1.25,
        None,
    )
    assert (first.where, second.where) == ("points[0]: ", "points[1]: ")


def test_a_single_point_and_a_single_command_are_not_numbered() -> None:
    (leg,) = check_joints(LIMITS, [trajectory(point(1.0, 0.5))], HERE)
    assert leg.where == ""
    legs = check_joints(
        LIMITS,
        [trajectory(point(1.0, 0.5)), trajectory(point(1.0, 0.5), point(2.0, 0.5))],
        HERE,
    )
    assert [leg.where for leg in legs] == [
        "steps[0]: ",
        "steps[1]: points[0]: ",
        "steps[1]: points[1]: ",
    ]


def test_a_refusal_names_the_step_and_keeps_the_hint() -> None:
    good, fast = trajectory(point(1.0, 0.1)), trajectory(point(0.1, 0.9))
    with pytest.raises(RefusedError, match=r"^steps\[1\]: a would move at 8 per second") as caught:
        check_joints(LIMITS, [good, fast], ZERO)
    assert caught.value.hint == "Give the step more time."
    assert refusal(fast).startswith("a would move at 9 per second, allowed is 2.")


@pytest.mark.parametrize(("count", "is_good"), [(0, False), (1, True), (MOST_POINTS, True)])
def test_a_trajectory_has_points_and_not_too_many(count: int, is_good: bool) -> None:
    points = [point(float(i + 1), 0.0) for i in range(count)]
    if is_good:
        assert len(check_joints(LIMITS, [trajectory(*points)], ZERO)) == count
    else:
        assert refusal(trajectory(*points)).startswith(f"The trajectory has {count} points")


def test_a_trajectory_of_one_point_too_many_is_refused() -> None:
    points = [point(0.0, 0.0)] * (MOST_POINTS + 1)
    assert "allowed is 1 .. 2000" in refusal(trajectory(*points))


def test_a_first_point_at_time_zero_is_where_the_joints_are() -> None:
    near = trajectory(point(0.0, 0.0009), point(1.0, 0.1))
    legs = check_joints(LIMITS, [near], ZERO)
    assert [leg.duration_s for leg in legs] == [0.0, 1.0]
    assert "time_from_start is 0 s" in refusal(trajectory(point(0.0, 0.0011), point(1.0, 0.1)))
    assert "points[1]: time_from_start is 0 s" in refusal(
        trajectory(point(0.0, 0.0), point(0.0, 0.0))
    )
    far = JointSample(names=("a",), position=np.array([1000.0]))
    wide = {"a": Limit(velocity=2.0)}
    assert "time_from_start is 0 s" in refusal(
        trajectory(point(0.0, 1000.005)), joints=far, limits=wide
    )


def test_times_of_points_only_grow() -> None:
    assert "points[1]: time_from_start is 1 s, expected more than 1 s" in refusal(
        trajectory(point(1.0, 0.0), point(1.0, 0.0))
    )
    assert "points[1]: time_from_start is 0.5 s" in refusal(
        trajectory(point(1.0, 0.0), point(0.5, 0.0))
    )
    check_joints(LIMITS, [trajectory(point(1.0, 0.0), point(1.001, 0.0))], ZERO)


def test_a_trajectory_takes_no_longer_than_its_step() -> None:
    command = trajectory(point(1.0, 0.1))
    for lasts_s in (1.0, 1.0 - Limit.SLACK, 2.0):
        check_joints(LIMITS, [command], ZERO, [lasts_s])
    assert refusal(command, durations_s=[0.99]) == (
        "The trajectory takes 1 s, its step only 0.99 s."
    )


def test_each_quantity_of_a_point_is_held_to_its_limit() -> None:
    for text, values in (
        ("velocity of a is 2.1, allowed is -2 .. 2", {"velocities": [2.1]}),
        ("acceleration of a is -10.1, allowed is -10 .. 10", {"accelerations": [-10.1]}),
        ("effort of a is 5.1, allowed is -5 .. 5", {"effort": [5.1]}),
        ("velocity has 2 values for 1 joints", {"velocities": [0.0, 0.0]}),
        ("effort has 2 values for 1 joints", {"effort": [0.0, 0.0]}),
        ("acceleration has 2 values for 1 joints", {"accelerations": [0.0, 0.0]}),
    ):
        command = trajectory(point(1.0, 0.1), point(2.0, 0.1, **values))
        assert refusal(command).startswith(f"points[1]: {text}")
    two = trajectory(point(1.0, 0.1, 0.1, velocities=[0.0, -2.1]), names=("a", "b"))
    assert refusal(two).startswith("points[0]: velocity of b is -2.1")


def test_positions_of_a_point_are_as_many_as_its_joints() -> None:
    assert refusal(trajectory(point(1.0, 0.1, 0.2))) == "points[0]: 2 positions for 1 joints."
    assert refusal(trajectory(point(1.0))) == "points[0]: 0 positions for 1 joints."


def test_names_of_joints_are_known_and_different() -> None:
    assert refusal(trajectory(point(1.0), names=())) == "The joint command names no joints."
    assert refusal(state("a", "x", position=[0.0, 0.0])) == (
        "Joint 'x' is unknown, the robot has a, b."
    )
    assert "names a joint twice" in refusal(state("a", "b", "a", position=[0.0, 0.0, 0.0]))


# Where the first step begins


def test_each_leg_begins_where_the_one_before_has_ended() -> None:
    check_joints(LIMITS, [trajectory(point(0.5, 0.9), point(0.6, 0.9))], HERE)
    assert "b would move at 2.5" in refusal(
        trajectory(point(0.5, 0.0, 0.0), point(1.0, 0.0, 1.25), names=("a", "b"))
    )
    moved = [state("a", position=[0.5]), trajectory(point(0.5, 0.6))]
    check_joints(LIMITS, moved, ZERO)
    assert "steps[1]: a would move" in refusal(moved[0], trajectory(point(0.1, 0.0)))


def test_joints_that_were_not_measured_are_not_moved_in_a_time() -> None:
    command = trajectory(point(1.0, 0.1, 0.1), names=("a", "b"))
    assert refusal(command, joints=None).startswith("The joints were not measured yet")
    some = JointSample(names=("a",), position=np.zeros(1))
    assert refusal(command, joints=some).startswith("Joint 'b' is not among the measured ones")


def test_a_measurement_has_a_number_for_each_joint() -> None:
    command = trajectory(point(1.0, 0.1))
    for numbers in (
        {"position": np.zeros(1)},
        {"position": np.zeros(3)},
        {"position": np.zeros(2), "velocity": np.zeros(1)},
        {"position": np.zeros(2), "velocity": np.zeros(3)},
    ):
        joints = JointSample(names=("a", "b"), **numbers)
        with pytest.raises(ValueError, match=r"is (shorter|longer) than"):
            check_joints(LIMITS, [command], joints)


@pytest.mark.parametrize("unknown", [math.nan, math.inf])
def test_a_measured_velocity_that_is_no_number_counts_as_rest(unknown: float) -> None:
    joints = JointSample(names=("a",), position=np.zeros(1), velocity=np.array([unknown]))
    check_joints(LIMITS, [trajectory(point(0.46, 0.5))], joints)
    assert "cannot go 0.5 in that time and rest there" in refusal(
        trajectory(point(0.44, 0.5)), joints=joints
    )


# How fast


def test_a_joint_may_move_just_as_fast_as_its_limit() -> None:
    check_joints(FREE, [trajectory(point(1.0, 2.0))], ZERO)
    check_joints(FREE, [trajectory(point(1.0, -2.0 * (1.0 + Limit.SLACK)))], ZERO)
    assert "a would move at 2 per second, allowed is 2." in refusal(
        trajectory(point(1.0, 2.0 * (1.0 + 2.0 * Limit.SLACK))), limits=FREE
    )


def test_a_joint_is_slower_near_a_limit_that_it_moves_towards() -> None:
    """0.02 before its limit it may still brake from sqrt(2 * 1 * 0.02) = 0.2 per second."""
    near = {"a": Limit(lower=-1.0, upper=1.0, velocity=2.0, braking=(0.0, 1.0))}
    start = JointSample(names=("a",), position=np.array([0.88]))
    check_joints(near, [trajectory(point(0.51, 0.98))], start)
    assert "allowed is 0.2 so near to its limit" in refusal(
        trajectory(point(0.49, 0.98)), joints=start, limits=near
    )
    back = JointSample(names=("a",), position=np.array([0.99]))
    check_joints(near, [trajectory(point(0.1, 0.9))], back)
    assert "allowed is 0.2 so near" in refusal(
        trajectory(point(0.49, -0.98)),
        joints=JointSample(names=("a",), position=np.array([-0.88])),
        limits=near,
    )


def test_a_joint_that_may_not_come_nearer_is_told_to_stay_away() -> None:
    near = {"a": Limit(lower=-1.0, upper=1.0, velocity=2.0, braking=(1.0, 1.0))}
    start = JointSample(names=("a",), position=np.array([0.9]))
    with pytest.raises(RefusedError) as caught:
        check_joints(near, [trajectory(point(1.0, 1.0))], start)
    assert caught.value.hint == "Stay farther from the limit."
    assert refusal(trajectory(point(0.1, 0.1)), limits={"a": Limit(velocity=0.5)}) == (
        "a would move at 1 per second, allowed is 0.5."
    )


# Accelerations


def test_a_joint_reaches_a_point_with_the_velocity_that_is_stated() -> None:
    check_joints(LIMITS, [trajectory(point(0.4, 0.4, velocities=[2.0]))], ZERO)
    assert "a cannot go 0.4 in that time: its acceleration is at most 10" in refusal(
        trajectory(point(0.4, 0.4, velocities=[-1.0]))
    )
    two = trajectory(point(0.4, 0.4, 0.4, velocities=[1.0, -1.0]), names=("a", "b"))
    assert "b cannot go 0.4" in refusal(two)


def test_a_trajectory_that_states_a_velocity_at_its_end_need_not_rest() -> None:
    check_joints(LIMITS, [trajectory(point(0.4, 0.4, velocities=[1.8]))], ZERO)
    assert "and rest there" in refusal(trajectory(point(0.3, 0.4)))


def test_each_joint_of_a_command_comes_to_rest() -> None:
    two = trajectory(point(0.3, 0.0, 0.4), names=("a", "b"))
    assert refusal(two).startswith("b cannot go 0.4 in that time and rest there")
    with pytest.raises(RefusedError) as caught:
        check_joints(LIMITS, [two], ZERO)
    assert caught.value.hint == "From rest to rest it needs 0.40 s."


def test_a_command_rests_when_its_step_lasts_longer_and_not_when_the_next_follows_at_once() -> None:
    there, on = trajectory(point(0.35, 0.4)), trajectory(point(0.5, 0.9))
    check_joints(LIMITS, [there, on], ZERO)
    check_joints(LIMITS, [there, on], ZERO, [0.35, 0.5])
    assert refusal(there, on, durations_s=[0.4, 0.5]).startswith(
        "steps[0]: a cannot go 0.4 in that time and rest there"
    )
    assert refusal(there).startswith("a cannot go 0.4 in that time and rest there")
    quarter = trajectory(point(0.25, 0.25))
    check_joints(LIMITS, [quarter, on], ZERO, [0.25, 0.5])


def test_a_first_point_at_time_zero_leaves_the_rest_of_the_step_for_a_rest() -> None:
    command = trajectory(point(0.0, 0.0), point(0.25, 0.25))
    assert refusal(command, trajectory(point(0.5, 0.5)), durations_s=[1.0, 0.5]).startswith(
        "steps[0]: points[1]: a cannot go 0.25 in that time and rest there"
    )


def test_a_command_after_a_rest_begins_from_rest() -> None:
    """Without the rest between them the second step would begin at 2 per second and brake."""
    there, on = trajectory(point(0.6, 0.4)), trajectory(point(0.3, 0.7))
    check_joints(LIMITS, [there, on], ZERO, [0.6, 0.5])
    assert refusal(there, on, durations_s=[1.0, 0.5]).startswith("steps[1]: a cannot go 0.3")
    check_joints(LIMITS, [there, trajectory(point(0.5, 0.7))], ZERO, [1.0, 0.5])


# Joint states


def test_a_joint_state_of_positions_is_a_leg_of_its_step() -> None:
    (leg,) = check_joints(LIMITS, [state("a", position=[0.6])], HERE, [1.5])
    assert (leg.names, leg.position.tolist(), leg.duration_s) == (("a",), [0.6], 1.5)
    assert (leg.velocity, leg.where) == (None, "")
    (leg,) = check_joints(LIMITS, [state("a", position=[0.6])], None)
    assert leg.duration_s is None


def test_a_joint_state_of_velocities_ends_where_they_lead() -> None:
    command = state("a", "b", velocity=[0.25, -1.0])
    (leg,) = check_joints(LIMITS, [command], HERE, [2.0])
    assert (leg.names, leg.position.tolist(), leg.duration_s) == (("a", "b"), [1.0, -1.75], 2.0)
    assert refusal(command, joints=HERE, durations_s=[2.1]) == (
        "a would be at 1.025 after 2.1 s, allowed is -1 .. 1."
    )
    assert "duration of the velocities is not known" in refusal(command)
    assert "not measured yet" in refusal(command, joints=None, durations_s=[2.0])


def test_a_joint_state_holds_positions_or_velocities_within_their_limits() -> None:
    assert "neither positions nor velocities" in refusal(state("a", effort=[1.0]))
    assert refusal(state("a", position=[0.0], effort=[5.1])).startswith("effort of a is 5.1")
    assert refusal(state("a", position=[0.0], velocity=[2.1])).startswith("velocity of a is 2.1")
    assert refusal(state("a", position=[1.1])).startswith("position of a is 1.1")
    assert refusal(state("a", velocity=[0.0, 0.0])).startswith("velocity has 2 values for 1")


def test_a_velocity_is_reached_within_its_step() -> None:
    check_joints(LIMITS, [state("b", velocity=[1.0])], ZERO, [0.1])
    check_joints(LIMITS, [state("b", velocity=[-1.0])], ZERO, [0.1])
    assert refusal(state("b", velocity=[1.01]), durations_s=[0.1]).startswith("b cannot go 0.101")
    moving = JointSample(names=("b",), position=np.zeros(1), velocity=np.array([1.0]))
    check_joints(LIMITS, [state("b", velocity=[2.0])], moving, [0.1])
    assert "cannot go" in refusal(state("b", velocity=[-0.5]), joints=moving, durations_s=[0.1])


def test_after_a_velocity_the_next_step_begins_with_it() -> None:
    spin = state("b", velocity=[1.0])
    check_joints(LIMITS, [spin, state("b", velocity=[2.0])], ZERO, [0.1, 0.1])
    assert refusal(spin, state("b", velocity=[-0.5]), durations_s=[0.1, 0.1]).startswith(
        "steps[1]: b cannot go"
    )
    assert refusal(spin, state("b", position=[0.0]), durations_s=[0.5, 0.1]).startswith(
        "steps[1]: b would move at 5"
    )


def test_a_velocity_of_which_none_is_the_end_needs_no_rest() -> None:
    check_joints(LIMITS, [state("b", velocity=[2.0])], ZERO, [0.2])


def test_a_step_of_no_time_is_not_judged_for_its_speed() -> None:
    (leg,) = check_joints(LIMITS, [state("a", position=[0.9])], ZERO, [0.0])
    assert leg.duration_s == 0.0
