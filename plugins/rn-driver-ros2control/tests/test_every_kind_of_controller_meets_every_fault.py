"""A table: kind of controller x gripper x what goes wrong, beside a strict stand-in."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from rn_driver_ros2control.driver import Ros2ControlDriver
from rn_driver_ros2control.link import End, ListedController
from rn_driver_ros2control.manager import listing
from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT
from rn_robot_fr3.profile import HOME_RAD
from rn_testing.waiting import wait_until
from roboneuron import InvalidInputError, JointCommand, NotReadyError, UnsafeError

KINDS = {
    "topic": {"mode": "topic"},
    "chunks": {"mode": "chunks"},
    "action": {"mode": "action"},
    "forward": {"controller_type": "forward-position"},
}
GRIPPERS = ("none", "gripper-command", "parallel-gripper-command")
STEP = 0.1


def command(step: float = STEP, duration_s: float = 0.2, **joints: float) -> JointCommand:
    position = [*HOME_RAD[:6], HOME_RAD[6] + step, *joints.values()]
    return JointCommand(
        names=(*ARM_JOINTS, *joints), position=np.array(position), duration_s=duration_s
    )


def moved(driver: Ros2ControlDriver) -> np.ndarray:
    """How far each joint of the arm is from home."""
    return driver.read().joints.position[:7] - HOME_RAD


def listed(state: str, *claimed_by: str) -> ListedController:
    return ListedController(
        state=state,
        claimed_by=claimed_by,
        others=("other (active)",),
        received_s=time.monotonic(),
    )


def make_inactive(rig, driver) -> None:
    rig.link.controller.active = False
    wait_until(lambda: driver.read().detail["controller"] == "inactive", 10.0)


def list_inactive(rig, driver) -> None:
    rig.link.listing = listed("inactive")
    make_inactive(rig, driver)


def list_claimed(rig, driver) -> None:
    rig.link.listing = listed("inactive", "other")
    make_inactive(rig, driver)


def list_nothing(rig, driver) -> None:
    rig.link.listing = listed("")
    make_inactive(rig, driver)


def remove(rig, driver) -> None:
    rig.link.is_there = False


def silence(rig, driver) -> None:
    rig.link.tells = False
    wait_until(lambda: time.monotonic() - rig.link.joints()[ARM_JOINTS[0]].received_s > 0.3, 10.0)


FAULTS: dict[str, tuple[Callable[..., None], tuple[str, ...]]] = {
    "inactive": (list_inactive, ("inactive", "--activate joint_trajectory_controller")),
    "claimed": (list_claimed, ("claimed by other", "--deactivate other --activate")),
    "not-listed": (list_nothing, ("lists no controller", "other (active)")),
    "gone": (remove, ("has gone",)),
    "silent": (silence, ("silent",)),
}
"""What goes wrong before a command, and words of the refusal; the driver sends nothing then."""


@pytest.mark.parametrize("gripper", GRIPPERS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_joint_gets_its_own_value_and_the_gripper_its_goal(rig, kind, gripper):
    driver = rig.driver(gripper=gripper, state_timeout_s=5.0, **KINDS[kind])
    sent = driver.send(command(**{FINGER_JOINT: 0.01}))
    is_driven = gripper != "none"
    assert (FINGER_JOINT in sent.names) is is_driven
    assert rig.link.gripper_goals == pytest.approx([0.01] if is_driven else [])
    expected = [0.0] * 6 + [STEP]
    wait_until(lambda: np.abs(moved(driver) - expected).max() < 0.005, 10.0)
    assert driver.read().detail["fault"] == ""


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_before_a_command_refuses_it_with_the_words_of_the_manager(rig, kind, fault):
    happen, words = FAULTS[fault]
    driver = rig.driver(state_timeout_s=0.2, **KINDS[kind])
    happen(rig, driver)
    with pytest.raises(NotReadyError) as caught:
        driver.send(command())
    assert all(word in str(caught.value) for word in words), caught.value
    assert rig.link.sent == []


@pytest.mark.parametrize("kind", ["topic", "chunks", "action"])
def test_an_inactive_controller_is_told_without_a_manager_too(rig, kind):
    driver = rig.driver(state_timeout_s=0.2, **KINDS[kind])
    make_inactive(rig, driver)
    with pytest.raises(NotReadyError, match="list_controllers"):
        driver.send(command())


def test_a_forward_controller_is_not_watched_where_no_manager_answers(rig):
    driver = rig.driver(state_timeout_s=5.0, **KINDS["forward"])
    assert driver.read().detail["controller"] == "not watched"
    rig.link.listing = listed("active")
    assert driver.read().detail["controller"] == "active"


@pytest.mark.parametrize("kind", KINDS)
def test_a_blocked_arm_is_a_fault_and_the_driver_holds(rig, kind):
    driver = rig.driver(
        path_tolerance=0.02,
        goal_tolerance=0.02,
        goal_time_tolerance_s=0.2,
        state_timeout_s=5.0,
        **KINDS[kind],
    )
    rig.link.controller.blocked = True
    driver.send(command(duration_s=0.5))
    wait_until(lambda: "path tolerance violated" in driver.read().detail["fault"], 10.0)
    with pytest.raises(UnsafeError, match="path tolerance violated"):
        driver.send(command())


ENDS = {
    (End.ABORTED, "Current goal preempted by new incoming action."): "another client",
    (End.ABORTED, "Current goal cancelled during deactivate transition."): "deactivated",
    (End.ABORTED, "Joint names do not match."): "Joint names do not match.",
    (End.ABORTED, ""): "another client sends goals, or the controller was deactivated",
    (End.PATH_TOLERANCE, "Aborted due to path tolerance violation"): "path tolerance violation",
    (End.GOAL_TOLERANCE, "Aborted due to goal_time_tolerance exceeding"): "goal_time_tolerance",
    (End.CANCELLED, ""): "another client has cancelled",
    (End.LOST, "no result"): "lost",
}
"""Ends of an accepted goal with the controller's text, and what the fault says."""


@pytest.mark.parametrize("gripper", ["none", "gripper-command"])
@pytest.mark.parametrize("end", ENDS, ids=lambda end: f"{end[0].name}-{end[1][:20]}")
def test_the_end_of_a_goal_is_a_fault_with_the_text_of_the_controller(rig, end, gripper):
    driver = rig.driver(gripper=gripper, state_timeout_s=5.0, **KINDS["action"])
    driver.send(command(duration_s=30.0))
    rig.link.end_from_outside(*end)
    told = driver.read().detail["fault"]
    assert ENDS[end] in told
    assert end[1] in told
    assert not (end[1].startswith("Joint") and "another client" in told), "no guess beside a reason"
    with pytest.raises(UnsafeError):
        driver.send(command())
    assert driver.recover() == told


@pytest.mark.parametrize("answers", [False, True], ids=["unanswered", "refused"])
def test_a_goal_that_is_not_taken_is_an_error_and_no_fault(rig, answers):
    driver = rig.driver(goal_timeout_s=0.1, state_timeout_s=5.0, **KINDS["action"])
    rig.link.answers = answers
    rig.link.controller.refusal = lambda trajectory, now_s: "Refused." if answers else ""
    with pytest.raises(InvalidInputError if answers else NotReadyError):
        driver.send(command())
    assert driver.read().detail["fault"] == ""


def test_a_forward_controller_moves_within_the_limits_and_stops_evenly(rig):
    driver = rig.driver(state_timeout_s=5.0, **KINDS["forward"])
    sent = driver.send(command(step=1.0, duration_s=0.01))
    assert sent.duration_s > 0.1, "the limits of velocity allow no jump"
    driver.send(command(step=0.0, duration_s=0.01))
    wait_until(lambda: abs(moved(driver)[6]) < 1e-3, 10.0)
    driver.send(command(step=1.0, duration_s=5.0))
    wait_until(lambda: moved(driver)[6] > 0.1, 10.0)
    driver.hold()
    wait_until(lambda: driver.read().joints.velocity[6] == 0.0, 10.0)
    assert 0.1 < moved(driver)[6] < 0.9
    assert driver.read().detail["fault"] == ""


class Listed:
    """A row of the controller manager's answer."""

    def __init__(self, name: str, state: str, claimed: str = "", needed: str = "") -> None:
        self.name, self.state = name, state
        self.claimed_interfaces, self.required_command_interfaces = claimed.split(), needed.split()


@pytest.mark.parametrize(
    ("others", "claimed_by"),
    [
        ([], ()),
        ([Listed("b", "active", "j1/position j2/position")], ("b",)),
        ([Listed("b", "inactive", "j1/position")], ()),
        ([Listed("b", "active", "j9/position")], ()),
        ([Listed("b", "active", "j1/position"), Listed("c", "active", "j2/position")], ("b", "c")),
    ],
)
def test_controllers_that_claim_the_same_joints_are_named(others, claimed_by):
    mine = Listed("a", "inactive", needed="j1/position j2/position")
    found = listing([mine, *others], "a", 1.0)
    assert (found.state, found.claimed_by) == ("inactive", claimed_by)
    assert listing(others, "a", 1.0).state == ""
