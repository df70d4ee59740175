"""Rows of other spaces than TCP deltas reach the arm with their meaning, and those of an
unsupported space do not; on a test clock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from control_cell import ARM, START, STOPS, TIMEOUT_S, MakeHost, duration_s
from space_cell import (
    FASTEST,
    PERIOD_S,
    POSES,
    POSITIONS,
    QUICKEST,
    ROWS,
    SPEED,
    STEADY,
    VELOCITIES,
    SpaceCell,
    each_space,
    joints_space,
)

from roboneuron.config.models import FIRST_STEP_S
from roboneuron.contract import EE_DELTA, ControlSpace, JointLimits
from roboneuron.errors import ConfigurationError
from roboneuron.modules.control.module import ControlModule
from roboneuron.ros.messages import to_action_message


@pytest.fixture
def make_cell(make_host: MakeHost, monkeypatch: pytest.MonkeyPatch) -> Callable[[float], SpaceCell]:
    """Return a function that makes a cell with this acceleration limit of the joints."""
    import loop_plugin

    def make(acceleration: float) -> SpaceCell:
        one = np.ones(2)
        limits = JointLimits(
            lower=-2 * one,
            upper=2 * one,
            velocity=FASTEST * one,
            acceleration=acceleration * one,
            effort=one,
        )
        profile = replace(loop_plugin.profile(), limits=limits)
        monkeypatch.setattr(loop_plugin, "profile", lambda: profile)
        return SpaceCell(make_host)

    return make


@pytest.fixture
def cell(make_cell: Callable[[float], SpaceCell]) -> SpaceCell:
    return make_cell(QUICKEST)


@each_space
def test_a_row_moves_the_arm(cell: SpaceCell, space: ControlSpace) -> None:
    cell.send(space)
    assert cell.commands[-1] == pytest.approx([0.51, -0.5])
    assert cell.drops() == {}


def test_a_controller_that_cannot_execute_is_refused(make_host: MakeHost) -> None:
    with pytest.raises(ConfigurationError, match="'boaster' declares joint_position, but has no"):
        ControlModule(make_host("control", replace={'"adder"': '"boaster"'}))


# Refusals

TWO_ARMS = [f"{arm}/{name}" for arm in ("left", "right") for name in ARM]
FOREIGN = [
    joints_space("joint_position", *reversed(ARM)),
    joints_space("joint_position", "a"),
    joints_space("joint_position", *ARM, "c"),
    joints_space("joint_position", *ARM, "gripper_open"),
    joints_space("joint_velocity", *TWO_ARMS, rate_hz=15.0),
    joints_space("joint_delta", *ARM),
]
UNKNOWN, BAD_RATE, NO_RATE = "this control executes", "Hz is none", "how long a velocity is held"
ODD_LABELS = {
    "": UNKNOWN,
    "joint_torque:a,b": UNKNOWN,
    "ee_delta_base@5": UNKNOWN,
    "ee_delta:a,b": UNKNOWN,
    "joint_position@fast:a,b": UNKNOWN,
    "joint_position@05:a,b": UNKNOWN,
    "joint_position@1e9:a,b": BAD_RATE,
    "joint_position@nan:a,b": BAD_RATE,
    "joint_position@-5:a,b": BAD_RATE,
    "joint_velocity:a,b": NO_RATE,
    "joint_velocity@0:a,b": UNKNOWN,
}


def check_refused(cell: SpaceCell, told: str, word: str = "malformed") -> None:
    """Check that one message was refused for that reason, and that the arm stays at rest."""
    assert cell.drops() == {word: 1}
    assert told in cell.host.values()["message"]
    assert cell.commands == []
    cell.go(1.0)
    cell.look()
    assert cell.commands == []


@pytest.mark.parametrize("space", FOREIGN, ids=lambda space: space.label)
def test_channels_that_the_robot_has_not_are_refused(cell: SpaceCell, space: ControlSpace) -> None:
    cell.send(space, [0.1] * space.size)
    executed = "'ee_delta_base', 'ee_pose:x,y,z,qx,qy,qz,qw', 'joint_position:a,b', "
    executed += "'joint_velocity:a,b'"
    told = f"An action is labelled {space.label!r}; this control executes {executed}."
    check_refused(cell, told)


@pytest.mark.parametrize("label", ODD_LABELS)
@pytest.mark.parametrize("size", [2, 7])
def test_a_label_that_only_looks_like_a_known_one_is_refused(
    cell: SpaceCell, label: str, size: int
) -> None:
    message = to_action_message(np.full(size, 0.01), POSITIONS)
    message.layout.dim[0].label = label
    cell.receive(message)
    check_refused(cell, ODD_LABELS[label])


@each_space
@pytest.mark.parametrize("size", [0, 1, 14, 1000])
def test_rows_of_another_size_are_refused(cell: SpaceCell, space: ControlSpace, size: int) -> None:
    cell.send(space, [0.0] * size)
    check_refused(cell, f"An action has shape ({size},), expected ({space.size},)")


@each_space
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none_are_refused(
    cell: SpaceCell, space: ControlSpace, value: float
) -> None:
    cell.send(space, [*ROWS[space][:-1], value])
    check_refused(cell, f"non-finite value at {space.keys[-1]}", "non_finite")


def test_a_quaternion_of_length_zero_is_refused(cell: SpaceCell) -> None:
    cell.send(POSES, [0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    check_refused(cell, "qx, qy, qz, qw have the length 0, expected 1")


def test_the_arm_comes_to_rest_when_a_label_becomes_unknown(cell: SpaceCell) -> None:
    for _ in range(3):
        cell.send(VELOCITIES)
        cell.go(PERIOD_S)
    cell.look()
    assert cell.code == ""
    count = len(cell.commands)
    held_s = 0.0
    while not cell.code:
        cell.send(FOREIGN[0], [1.0, 1.0])
        cell.go(PERIOD_S)
        held_s += PERIOD_S
        cell.look()
    assert cell.code == "no_action"
    assert held_s <= TIMEOUT_S
    assert cell.drops() == {"malformed": round(held_s / PERIOD_S)}
    assert len(cell.commands) == count + 1, "one hold, and nothing else"
    assert cell.commands[-1] == pytest.approx([0.5 + 3 * SPEED * PERIOD_S, -0.5])


# Velocities


def travelled(cell: SpaceCell) -> float:
    """Displacement of joint a after the newest command."""
    cell.go(1.0)
    return float(cell.place()[0] - START[0])


JITTER = [0.05, 0.02, 0.08, 0.03, 0.07, 0.049, 0.051, 0.06, 0.04, 0.05]
"""Times between messages that are sent every 0.05 s [s]."""


@pytest.mark.parametrize(
    "pauses",
    [[PERIOD_S] * 10, JITTER, [0.03, 0.07] * 5, [0.07, 0.03] * 5],
    ids=["in-time", "jitter", "early-late", "late-early"],
)
def test_velocities_add_up_whenever_their_messages_arrive(
    cell: SpaceCell, pauses: list[float]
) -> None:
    for pause_s in pauses:
        cell.send(VELOCITIES)
        cell.go(pause_s)
    assert travelled(cell) == pytest.approx(10 * SPEED * PERIOD_S, abs=1e-12)
    assert cell.drops() == {}
    assert not any(key.startswith("limited.") for key in cell.host.values())


def test_velocities_of_both_signs_come_back(cell: SpaceCell) -> None:
    for pause_s, sign in zip(JITTER, [1, 1, -1, 1, -1, -1, -1, 1, 1, -1], strict=True):
        cell.send(VELOCITIES, [sign * SPEED, -sign * SPEED / 2])
        cell.go(pause_s)
    assert travelled(cell) == pytest.approx(0.0, abs=1e-12)
    assert cell.place()[1] == pytest.approx(START[1], abs=1e-12)


def test_a_missed_period_is_not_made_up_for(cell: SpaceCell) -> None:
    for period in range(10):
        if period != 4:
            cell.send(VELOCITIES)
        cell.go(PERIOD_S)
        assert cell.speed() <= SPEED * (1 + 1e-9)
    assert travelled(cell) == pytest.approx(9 * SPEED * PERIOD_S, abs=1e-12)


@pytest.mark.parametrize("space", [VELOCITIES, STEADY], ids=lambda space: space.kind)
def test_a_steady_motion_is_not_cut_off_because_a_message_was_late(
    make_cell: Callable[[float], SpaceCell], space: ControlSpace
) -> None:
    """One is 40 ms late, the next one in time: the gap must not be caught up within 10 ms."""
    cell = make_cell(10.0)
    speed = 0.28
    for row, share in enumerate([1.0, 1.0, 1.8, 0.2, 1.0, 1.0, 1.8, 0.2, 1.0, 1.0], 1):
        place = START[0] + row * speed * PERIOD_S
        cell.send(space, [speed if space is VELOCITIES else place, START[1] * (space is STEADY)])
        assert cell.speed() <= 1.3 * speed
        cell.go(PERIOD_S * share)
    assert not any(key.startswith("limited.") for key in cell.host.values())
    assert travelled(cell) == pytest.approx(10 * speed * PERIOD_S, abs=1e-12)


def test_an_arm_that_was_late_is_in_time_again_after_some_rows(cell: SpaceCell) -> None:
    cell.send(VELOCITIES)
    cell.go(0.2 * PERIOD_S)
    for _ in range(8):
        cell.send(VELOCITIES)
        cell.go(PERIOD_S)
    assert cell.place()[0] - START[0] == pytest.approx(9 * SPEED * PERIOD_S, abs=1e-4)


def test_messages_that_arrive_together_are_no_faster_than_the_limit(cell: SpaceCell) -> None:
    """Motion cut off by the limit is lost: nothing is caught up."""
    for _ in range(10):
        cell.send(VELOCITIES)
        cell.go(0.001)
        assert cell.speed() <= FASTEST * (1 + 1e-6)
    assert int(cell.host.values()["limited.acceleration"]) > 0
    assert travelled(cell) < 10 * SPEED * PERIOD_S
    cell.send(VELOCITIES)
    assert cell.speed() == pytest.approx(SPEED)


def test_the_step_is_that_of_the_label(cell: SpaceCell) -> None:
    slow = replace(VELOCITIES, rate_hz=5.0)
    cell.send(slow, [SPEED, 0.0])
    assert duration_s(cell.messages[-1]) == pytest.approx(0.2)
    assert cell.commands[-1][0] == pytest.approx(0.5 + SPEED * 0.2)


def test_velocities_count_from_where_the_arm_is_held(cell: SpaceCell) -> None:
    cell.send(VELOCITIES)
    cell.go(0.6 * PERIOD_S)
    cell.host.stopped = True
    cell.control.stop("emergency_stop")
    cell._follow(len(cell.messages) - 1)
    held = cell.place()[0]
    assert held == pytest.approx(0.5 + 0.6 * SPEED * PERIOD_S)
    cell.host.stopped = False
    cell.go(PERIOD_S)
    cell.send(VELOCITIES)
    assert cell.commands[-1][0] == pytest.approx(held + SPEED * PERIOD_S)


def test_velocities_count_from_the_measured_joints_when_the_arm_does_not_follow(
    cell: SpaceCell,
) -> None:
    cell.send(VELOCITIES)
    cell.clock.go(PERIOD_S)
    cell.position = START - 0.11
    cell.measure()
    cell.send(VELOCITIES)
    assert cell.commands[-1][0] == pytest.approx(0.39 + SPEED * PERIOD_S)


# Stops


@each_space
@pytest.mark.parametrize("stop", STOPS)
def test_a_stop_holds_in_every_space(cell: SpaceCell, space: ControlSpace, stop: str) -> None:
    cell.send(space)
    count = len(cell.commands)
    STOPS[stop](cell)
    cell.send(space)
    assert len(cell.commands) == count
    assert cell.drops() == {stop: 1}


@each_space
def test_the_watchdog_holds_in_every_space(cell: SpaceCell, space: ControlSpace) -> None:
    cell.send(space)
    cell.go(TIMEOUT_S * 0.75 - 1e-6)
    cell.look()
    assert cell.code == ""
    cell.go(2e-6)
    cell.look()
    assert cell.code == "no_action"
    assert cell.commands[-1] == pytest.approx([0.51, -0.5])


@each_space
def test_an_old_row_is_dropped_in_every_space(cell: SpaceCell, space: ControlSpace) -> None:
    cell.receive(to_action_message(np.array(ROWS[space]), space), age_s=TIMEOUT_S + 1e-3)
    assert cell.commands == []
    assert cell.drops() == {"stale_action": 1}


# Switches


@each_space
@pytest.mark.parametrize("later", ROWS, ids=lambda space: space.kind)
def test_a_policy_of_another_space_goes_on_at_the_border_of_a_period(
    cell: SpaceCell, space: ControlSpace, later: ControlSpace
) -> None:
    cell.send(space)
    cell.go(FIRST_STEP_S)
    before = cell.place()
    row = {
        "ee_pose": [before[0] + 0.01, *before[1:], 0, 0, 0, 0, 1],
        "joint_position": [before[0] + 0.01, before[1]],
    }.get(later.kind, ROWS[later])
    cell.send(later, row)
    cell.go(FIRST_STEP_S)
    assert cell.place() - before == pytest.approx([0.01, 0.0])
    assert cell.drops() == {}
    assert not any(key.startswith("limited.") for key in cell.host.values())


def test_positions_after_deltas_are_no_faster_than_the_limit(cell: SpaceCell) -> None:
    """A policy of positions that starts far from the arm does not make it jump."""
    cell.send(EE_DELTA)
    cell.go(PERIOD_S)
    for _ in range(30):
        cell.send(POSITIONS, [1.5, -0.5])
        assert cell.speed() <= FASTEST * (1 + 1e-6)
        cell.go(PERIOD_S)
    assert cell.place() == pytest.approx([1.5, -0.5])
