"""Invalid actions and joint states for two FR3s, in the control module with its real controller and
limits on a test clock: one clear error each, and both arms at rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_loop import Clock, _Host
from numpy.typing import NDArray

from rn_robot_fr3.cell import PAIR
from rn_robot_fr3.profile import HOME_RAD, pair_profile
from roboneuron.config import ModuleSettings, parse_config
from roboneuron.contract import EE_DELTA, ControlSpace, JointSample, robot_space
from roboneuron.modules import holding
from roboneuron.modules.control import module as control_module
from roboneuron.modules.control.module import ControlModule
from roboneuron.ros.messages import to_action_message, to_joint_state

F64 = NDArray[np.float64]
ROBOT = pair_profile()
ARMS = ("left", "right")
LED_RAD = 0.12
"""Maximum lead of a commanded joint over its measured position: `LOST` of the limits and two rows;
40 rows would lead by 0.4 rad.
"""
RATE_HZ = 10.0
PERIOD_S = 1.0 / RATE_HZ
SPEED_RAD_S = 0.1
VELOCITIES = robot_space("joint_velocity", ROBOT, RATE_HZ)
POSITIONS = robot_space("joint_position", ROBOT)
TIMEOUT_S, STATE_TIMEOUT_S = 0.5, 0.25
"""Configured timeouts of actions and of joint states."""
CONFIG = f"""
[robot]
name = "fr3-pair"
[control]
controller = "urdf"
action_timeout_s = {TIMEOUT_S}
state_timeout_s = {STATE_TIMEOUT_S}
"""
OWN = {arm: [i for i, name in enumerate(ROBOT.arm_joints) if name.startswith(arm)] for arm in ARMS}


class Arms:
    """An active control, and two arms that follow it exactly."""

    def __init__(self, state: Path, clock: Clock) -> None:
        self.clock = clock
        settings = ModuleSettings(
            kind="control",
            node_name="control",
            config=parse_config(CONFIG),
            state_directory=str(state),
        )
        self.host = _Host(settings, clock)
        self.control = ControlModule(self.host)  # type: ignore[arg-type]
        self.position = np.tile([*HOME_RAD, 0.04, 0.04], 2)
        self._start, self._end = self.position, self.position
        self._sent_s, self._lasts_s = 0.0, 1.0
        self.sent = self._row = 0
        # transforms a measurement before control receives it
        self.fault: Any = lambda joints: joints
        self.control.activate()
        self.measure()

    def measure(self) -> None:
        """Deliver a joint state, if the fault permits it."""
        joints = JointSample(
            names=PAIR.joints, position=self.position.copy(), stamp_ns=self.clock.time_ns()
        )
        told = self.fault(joints)
        if told is not None:
            self.host.subscribed["joint_states"](to_joint_state(told))

    def act(self, space: ControlSpace, row: F64, label: str | None = None) -> None:
        """Deliver an action."""
        message = to_action_message(row, space)
        if label is not None:
            message.layout.dim[0].label = label
        self.host.subscribed["action"](message, {"source_timestamp": self.clock.time_ns()})
        self._take()

    def go(self, seconds: float) -> None:
        """Advance time in small steps, with motion, measurements and the watchdog's checks."""
        for _ in range(round(seconds / 0.02)):
            self.clock.now_s += 0.02
            share = min(1.0, (self.clock.now_s - self._sent_s) / self._lasts_s)
            place = self._start + share * (self._end - self._start)
            self.position = place
            self.measure()
            self.host.repeated[0]()
            self._take()

    def _take(self) -> None:
        messages = self.host.publishers["joint_trajectory"].messages
        for message in messages:
            (point,) = message.points
            self._start, self._end = self.position, self.position.copy()
            for name, value in zip(message.joint_names, point.positions, strict=True):
                self._end[PAIR.joints.index(name)] = value
            self._sent_s = self.clock.now_s
            self._lasts_s = point.time_from_start.sec + point.time_from_start.nanosec / 1e9
            self.sent += 1
        messages.clear()

    def wave(self, periods: int) -> None:
        """Let a policy move every joint of both arms to and fro."""
        signs = np.tile([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0], 2) * SPEED_RAD_S
        left, right = np.split(signs, 2)
        for _ in range(periods):
            there = 1.0 if self._row % 16 < 8 else -1.0
            self._row += 1
            self.act(VELOCITIES, np.concatenate([there * left, [1.0], there * right, [1.0]]))
            self.go(PERIOD_S)

    @property
    def status(self) -> dict[str, str]:
        message = self.host.status.to_message()
        return {"message": message.message} | {pair.key: pair.value for pair in message.values}


@pytest.fixture
def arms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Arms]:
    clock = Clock()
    for module in (control_module, holding):
        monkeypatch.setattr(module, "time", clock)
    made = Arms(tmp_path, clock)
    yield made
    made.host.resources.close()


def check_moving(arms: Arms) -> None:
    """Check that both arms move."""
    arms._row = 0
    arms.wave(4)
    before = arms.position.copy()
    arms.wave(1)
    moved = np.abs(arms.position - before)
    places = {arm: [PAIR.joints.index(ROBOT.arm_joints[i]) for i in OWN[arm]] for arm in ARMS}
    assert all(moved[places[arm]].max() > 0.5 * SPEED_RAD_S * PERIOD_S for arm in ARMS)


def check_rest(arms: Arms) -> None:
    """Check that both arms stand within the timeout and the length of a hold, and keep standing."""
    arms.go(TIMEOUT_S + 0.3)
    before, sent = arms.position.copy(), arms.sent
    arms.go(1.0)
    assert np.abs(arms.position - before).max() < 1e-9
    assert arms.sent == sent, "nothing is commanded"


def _one_arm(arm: str) -> ControlSpace:
    """Joint positions of one arm only."""
    channels = tuple(channel for channel in POSITIONS.channels if channel.arm == arm)
    return ControlSpace(kind="joint_position", channels=channels)


def _renamed(arm: str) -> str:
    return POSITIONS.label.replace("right/", f"{arm}/")


HOME = np.tile([*HOME_RAD, 1.0], 2)
EXECUTES = "this control executes 'ee_pose:left/x"
NONSENSE: dict[str, tuple[ControlSpace, F64, str | None, str, str]] = {
    "fourteen-values-for-one-arm": (_one_arm("left"), np.zeros(14), None, "malformed", EXECUTES),
    "one-arm-alone": (_one_arm("right"), HOME[:8], None, "malformed", EXECUTES),
    "channels-of-another-arm": (POSITIONS, HOME, _renamed("middle"), "malformed", EXECUTES),
    "fourteen-of-sixteen-values": (
        POSITIONS,
        HOME[:14],
        None,
        "malformed",
        "An action has shape (14,), expected (16,)",
    ),
    "nan-velocity": (
        VELOCITIES,
        np.where(np.arange(16) == 9, np.nan, 0.1),
        None,
        "non_finite",
        "non-finite value at right/right_fr3_joint2",
    ),
    "unknown-label": (POSITIONS, HOME, "torque:left/left_fr3_joint1", "malformed", EXECUTES),
    "seven-values-of-one-arm": (EE_DELTA, np.full(7, 0.01), None, "malformed", EXECUTES),
}


@pytest.mark.parametrize("fault", NONSENSE)
def test_nonsense_for_two_arms_is_one_error_and_both_rest(arms: Arms, fault: str) -> None:
    space, row, label, word, told = NONSENSE[fault]
    check_moving(arms)
    arms.act(space, row, label)
    assert dict(arms.host.status.dropped) == {word: 1}
    assert told in arms.status["error"]
    check_rest(arms)
    assert arms.status["hold_code"] == "no_action"


def test_nonsense_beside_a_policy_does_not_stop_it(arms: Arms) -> None:
    check_moving(arms)
    for space, row, label, _, _ in NONSENSE.values():
        arms.act(space, row, label)
        arms.wave(1)
    check_moving(arms)


def test_rows_of_another_space_go_on_from_where_the_arms_are(arms: Arms) -> None:
    """As after a warm switch from velocities to positions."""
    check_moving(arms)
    places = [PAIR.joints.index(name) for name in ROBOT.arm_joints]
    left, right = np.split(arms.position[places], 2)
    arms.act(POSITIONS, np.concatenate([left, [1.0], right, [1.0]]))
    arms.go(PERIOD_S)
    assert np.abs(arms.position[places] - np.concatenate([left, right])).max() < 0.05
    assert dict(arms.host.status.dropped) == {}


def _without(arm: str) -> Any:
    def silent(joints: JointSample) -> JointSample:
        kept = [i for i, name in enumerate(joints.names) if not name.startswith(arm)]
        names = tuple(joints.names[i] for i in kept)
        return JointSample(names=names, position=joints.position[kept], stamp_ns=joints.stamp_ns)

    return silent


def _nan_of(arm: str) -> Any:
    def broken(joints: JointSample) -> JointSample:
        mine = np.array([name.startswith(arm) for name in joints.names])
        position = np.where(mine, np.nan, joints.position)
        return JointSample(names=joints.names, position=position, stamp_ns=joints.stamp_ns)

    return broken


FAULTS = {"silent": _without, "not-finite": _nan_of}


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("fault", FAULTS)
def test_joint_states_of_one_arm_with_a_fault_stop_both(arms: Arms, arm: str, fault: str) -> None:
    check_moving(arms)
    arms.fault = FAULTS[fault](arm)
    count = arms.sent
    arms.wave(round(STATE_TIMEOUT_S / PERIOD_S) + 2)
    assert arms.sent > count, "until it is known that they are at fault"
    before, sent = arms.position.copy(), arms.sent
    arms.wave(10)
    assert arms.sent == sent, "no arm is commanded, though the policy goes on"
    assert np.abs(arms.position - before).max() <= SPEED_RAD_S * 0.02
    assert arms.status["hold_code"] == "stale_joint_state"
    assert arms.host.status.dropped["bad_joint_state"] > 0
    arms.fault = lambda joints: joints
    arms.go(0.2)
    assert arms.sent == sent + 1, "both are held where they are measured"
    check_moving(arms)


@pytest.mark.parametrize("arm", ARMS)
def test_an_arm_that_is_measured_at_one_place_is_led_no_farther(arms: Arms, arm: str) -> None:
    """Its states continue with new stamps and frozen positions: commands stay within one period's
    distance of the measurement, so that an arm that moves after all only creeps.
    """
    check_moving(arms)
    mine = np.array([name.startswith(arm) for name in PAIR.joints])
    frozen = arms.position.copy()

    def stuck(joints: JointSample) -> JointSample:
        position = np.where(mine, frozen, joints.position)
        return JointSample(names=joints.names, position=position, stamp_ns=joints.stamp_ns)

    arms.fault = stuck
    for _ in range(40):
        arms._row = 0  # continued motion in one direction
        arms.wave(1)
        led = np.abs(arms._end - frozen)[mine].max()
        assert led <= LED_RAD, f"it is commanded {led:.3f} rad from where it is measured"
    arms.go(TIMEOUT_S + 0.3)
    check_rest(arms)
