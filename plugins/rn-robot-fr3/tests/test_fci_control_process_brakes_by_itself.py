"""The process that answers the arm brakes without its parent, and moves nothing after an error
until a recovery.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("ruckig", reason="needs ruckig: pip install './plugins/rn-robot-fr3[fci]'")

from rn_robot_fr3.fci import control_process
from rn_robot_fr3.fci.control_process import SILENT_S, ControlProcess
from rn_robot_fr3.fci.follower import JOINTS, CommandedState
from rn_robot_fr3.profile import HOME_RAD

_PATIENCE_S = 10.0
HOME = list(HOME_RAD)


class ControlException(Exception):
    """The arm ended a motion."""


class Robot:
    """An arm in virtual time: the next state is available at once."""

    def __init__(self) -> None:
        self.arm = CommandedState(list(HOME), [0.0] * JOINTS, [0.0] * JOINTS)
        self.at_ms = 0
        self.did: list[str] = []
        self.error: Exception | None = None
        self.gap = 0
        self._answered = True

    def state(self) -> Any:
        self.at_ms += 1
        at_s = self.at_ms / 1000.0
        arm = self.arm
        return SimpleNamespace(
            **{
                name: [0.0] * size
                for name, size in (("q", 7), ("dq", 7), ("tau_J", 7), ("O_T_EE", 16))
            },
            tau_ext_hat_filtered=[0.0] * 7,
            O_F_ext_hat_K=[0.0] * 6,
            q_d=arm.position,
            dq_d=arm.velocity,
            ddq_d=arm.acceleration,
            time=SimpleNamespace(to_sec=lambda: at_s),
            robot_mode=SimpleNamespace(name="Idle"),
            control_command_success_rate=1.0,
            current_errors=None,
        )

    read_once = state

    def start_joint_position_control(self, mode: object) -> Robot:
        self.did.append("start")
        return self

    def readOnce(self) -> tuple[Any, None]:
        if self.error is not None:
            error, self.error = self.error, None
            raise error
        gap, self.gap = self.gap + (not self._answered), 0
        self.at_ms += gap
        self.arm = self.arm.missed(gap)
        self._answered = False
        time.sleep(2e-5)  # yields to the test
        return self.state(), None

    def writeOnce(self, command: Any) -> None:
        self._answered = True
        self.arm = self.arm.sent(command.q)
        if command.motion_finished:
            self.did.append("finished")

    def set_collision_behavior(self, *thresholds: object) -> None:
        self.did.append("set")

    def automatic_error_recovery(self) -> None:
        self.did.append("recovered")


class Parent:
    """Messages from and to the driver's process."""

    def __init__(self, link: socket.socket, robot: Robot) -> None:
        self.link, self.robot = link, robot
        self.heard: list[dict[str, Any]] = []
        self.is_silent = False
        self._number = 0
        self.hear = threading.Thread(target=self._hear, daemon=True)
        self.hear.start()

    def _hear(self) -> None:
        while message := self.link.recv(65536):
            self.heard.append(json.loads(message))

    def say(self, what: str, **more: object) -> None:
        self._number += 1
        self.link.send(json.dumps({"do": what, "number": self._number, **more}).encode())

    def go(self, way: float = 0.3) -> None:
        target = [q + way for q in HOME]
        self.say("go", target=target, velocity=[0.5] * 7, acceleration=[3.0] * 7, jerk=[500.0] * 7)

    def until(self, check: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + _PATIENCE_S
        while not check():
            assert time.monotonic() < deadline_s, (self.robot.did, self.heard[-2:])
            if not self.is_silent:
                self.link.send(b'{"do": "alive"}')
            time.sleep(0.001)

    def speed(self) -> float:
        return max(map(abs, self.robot.arm.velocity))

    def ended(self) -> list[str]:
        return [message["ended"] for message in self.heard if "ended" in message]


@pytest.fixture
def parent(monkeypatch: pytest.MonkeyPatch) -> Iterator[Parent]:
    # threads of a test compete for the processor
    monkeypatch.setattr(control_process, "_ANSWER_S", 5.0)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    robot = Robot()
    client = SimpleNamespace(
        Errors=type("Errors", (), {}),
        ControllerMode=SimpleNamespace(JointImpedance=0),
        RealtimeConfig=SimpleNamespace(kEnforce=1, kIgnore=0),
        JointPositions=lambda q: SimpleNamespace(q=list(q), motion_finished=False),
        Robot=lambda host, config: robot,
    )
    process = ControlProcess(theirs, client, is_realtime=False)
    running = threading.Thread(target=process.run, daemon=True)
    running.start()
    made = Parent(ours, robot)
    made.say(
        "connect",
        arguments={
            "host": "x",
            "is_required": False,
            "stop_acceleration": [9.0] * 7,
            "stop_jerk": [1800.0] * 7,
        },
    )
    made.until(lambda: any("answer" in message for message in made.heard))
    yield made
    ours.shutdown(socket.SHUT_WR)
    running.join(_PATIENCE_S)
    assert not running.is_alive(), "it ends when its parent is gone"
    theirs.close()
    made.hear.join(_PATIENCE_S)
    ours.close()


def test_it_goes_and_brakes_when_it_is_told(parent: Parent) -> None:
    parent.go()
    parent.until(lambda: parent.speed() > 0.1)
    parent.say("brake")
    parent.until(lambda: "finished" in parent.robot.did)
    assert parent.speed() < 1e-6
    assert parent.ended() == []


def test_it_brakes_when_its_parent_is_silent(parent: Parent) -> None:
    parent.go(way=2.0)
    parent.until(lambda: parent.speed() > 0.1)
    parent.is_silent = True
    began_s = time.monotonic()
    parent.until(lambda: "finished" in parent.robot.did)
    assert time.monotonic() - began_s > SILENT_S / 2
    assert parent.speed() < 1e-6


def test_it_brakes_and_ends_when_its_parent_is_gone(parent: Parent) -> None:
    parent.go(way=2.0)
    parent.until(lambda: parent.speed() > 0.1)
    parent.link.shutdown(socket.SHUT_WR)
    parent.is_silent = True
    parent.until(lambda: "finished" in parent.robot.did)
    assert parent.speed() < 1e-6


def test_after_an_error_a_recovery_moves_nothing_and_only_a_new_target_does(parent: Parent) -> None:
    parent.go()
    parent.until(lambda: parent.speed() > 0.1)
    parent.robot.error = ControlException('aborted ["joint_reflex"]')
    parent.until(lambda: parent.ended() == ["ControlException"])
    starts = parent.robot.did.count("start")
    parent.go()  # sent before the driver knew of the fault
    parent.say("recover")
    parent.until(lambda: "recovered" in parent.robot.did)
    states = len(parent.heard)
    parent.until(lambda: len(parent.heard) > states + 3)
    assert parent.robot.did.count("start") == starts, "a recovery resumes nothing"
    parent.robot.arm = CommandedState(list(HOME), [0.0] * JOINTS, [0.0] * JOINTS)
    parent.go()
    parent.until(lambda: parent.robot.did.count("start") == starts + 1)


def test_a_silence_that_is_longer_than_the_arm_extrapolates_ends_the_motion(parent: Parent) -> None:
    parent.go(way=2.0)
    parent.until(lambda: parent.speed() > 0.1)
    parent.robot.gap = 25
    parent.until(lambda: parent.ended() == ["CommunicationLost"])
    parent.until(lambda: "finished" in parent.robot.did)
    assert parent.speed() < 1e-6


@pytest.mark.parametrize("is_granted", [True, False])
def test_it_asks_to_be_scheduled_first_and_runs_all_the_same(
    monkeypatch: pytest.MonkeyPatch, is_granted: bool
) -> None:
    asked = []

    def set_scheduler(pid: int, policy: int, parameter: os.sched_param) -> None:
        if not is_granted:
            raise PermissionError
        asked.append((policy, parameter.sched_priority))

    monkeypatch.setattr(os, "sched_setscheduler", set_scheduler)
    monkeypatch.setattr(
        control_process.ctypes, "CDLL", lambda _: SimpleNamespace(mlockall=lambda _: 0)
    )
    assert control_process._is_first_in_line() == is_granted
    assert asked == ([(os.SCHED_FIFO, 20)] if is_granted else [])
