"""A served FR3 moved directly by an MCP client: it stops when the server freezes and when it is
stopped, and does not move again.

Judged by the measured joints. Client, server and robot are separate processes.
"""

from __future__ import annotations

import json
import os
import pty
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from anyio.from_thread import BlockingPortal
from mcp import Client

from rn_testing.agent import blocking_client
from rn_testing.domain import free_ros_domain
from rn_testing.waiting import holds_within, wait_until
from roboneuron.estop import ESTOP_FILE
from roboneuron.ros.environment import prepare_environment

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]
CONFIG = """
[robot]
name = "fr3"
server_timeout_s = {bound_s}
[supervisor]
state_directory = "{state}"
"""
BOUND_S, BRAKING_S = 1.0, 1.0
STILL_RAD_S = 0.02
Wait = Callable[[Callable[[], bool], float, str], float]


class ServedArm:
    """An MCP client, and an observer of the joints on the same graph."""

    def __init__(self, client: Client, portal: BlockingPortal, state: Path) -> None:
        from sensor_msgs.msg import JointState

        from roboneuron.ros.link import RosLink
        from roboneuron.ros.qos import NEWEST

        self._client, self._portal, self.state = client, portal, state
        self.position = np.zeros(7)
        self.velocity: list[tuple[float, float]] = []
        self.last_moving_s = 0.0
        """By the robot's own stamp, which a busy observer does not delay."""
        self.link = RosLink("witness")
        self.link.open()
        self.link.subscribe(JointState, "/fr3/joint_states", self._on_state, NEWEST)

    def _on_state(self, message: Any) -> None:
        self.position = np.array(message.position[:7])
        speed = float(np.abs(message.velocity[:7]).max())
        stamp_s = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        self.velocity.append((stamp_s, speed))
        if speed >= STILL_RAD_S:
            self.last_moving_s = stamp_s

    def answer(self, tool: str, **arguments: Any) -> Any:
        return self._portal.call(self._client.call_tool, tool, arguments)

    def do(self, tool: str, **arguments: Any) -> dict[str, Any]:
        answer = self.answer(tool, **arguments)
        assert not answer.is_error, answer.content
        return dict(answer.structured_content)

    def robot(self) -> dict[str, Any]:
        return next(
            m for m in self.do("get_status", details=True)["modules"] if m["module"] == "robot"
        )

    def is_moving(self) -> bool:
        return bool(self.velocity) and self.velocity[-1][1] > 5 * STILL_RAD_S

    def is_still(self) -> bool:
        """Whether it stood for 0.2 s up to now; a busy witness misses states."""
        known = self.velocity[-100:]
        newest_s = known[-1][0] if known else 0.0
        recent = [speed for at_s, speed in known if at_s > newest_s - 0.2]
        is_known = newest_s > time.time() - 0.5 and len(recent) > 2
        return is_known and max(recent) < STILL_RAD_S

    def move_away(self) -> threading.Thread:
        """Start a long turn of the wrist, which stays in the workspace, with a call that keeps
        running.
        """
        robot = self.robot()
        if robot["phase"] != "running":
            # a busy machine or an earlier test may have ended it; the test is about what follows
            print(f"The robot is started anew: {robot}", file=sys.stderr)
            self.do("start_robot")
        if self.do("get_status")["emergency_stop"]:
            print("A failed test has left the stop latched.", file=sys.stderr)
            self.release()
            wait_until(lambda: not self.do("get_status")["emergency_stop"], 5.0, "it is released")
        target = 2.2 if self.position[6] < 0 else -2.0
        arguments = {"positions": {"fr3_joint7": target}, "duration_s": 8.0}
        self.told = ""

        def call() -> None:
            self.told = str(self.answer("move_joints", **arguments).content)[:500]

        self._call = threading.Thread(target=call)
        self._call.start()
        return self._call

    def moves_to(self, wrist: float) -> None:
        """A call moves the wrist there. A busy machine may keep the server or the states silent for
        longer than its bounds, which ends a motion: the next call moves it all the same.
        """
        for _ in range(3):
            answer = self.answer("move_joints", positions={"fr3_joint7": wrist})
            if not answer.is_error:
                assert answer.structured_content["error"] < 0.01
                return
            print(f"The motion was ended: {answer.content}", file=sys.stderr)
            assert answer.meta["roboneuron/error"]["code"] in {"not_ready", "wrong_state"}
        raise AssertionError(f"No call moves the arm: {answer.content}")

    def wait_moving(self) -> None:
        """Raises AssertionError with the results of the call and the robot."""
        for _ in range(3):
            holds_within(lambda: self.is_moving() or not self._call.is_alive(), 30.0)
            if self.is_moving():
                return
            if "Ask again" in self.told:  # a busy machine kept the server silent before the motion
                self.move_away()
        raise AssertionError(f"The arm does not move: {self.told} {self.robot()}")

    def lose_state(self) -> None:
        """Remove the state directory, all of it at once: a removal file by file would also remove
        what the server writes meanwhile.
        """
        lost = self.state.with_name(f"lost-{time.monotonic_ns()}")
        self.state.rename(lost)
        shutil.rmtree(lost, ignore_errors=True)  # the server may still write to it

    def release(self) -> None:
        """Release as a person does: confirm in a terminal."""
        person, terminal = pty.openpty()
        try:
            os.write(person, b"y\n")
            command = [
                sys.executable,
                "-m",
                "roboneuron.cli.main",
                "estop",
                "--reset",
                "--state",
                str(self.state),
            ]
            subprocess.run(command, stdin=terminal, check=True, timeout=60, capture_output=True)
        finally:
            os.close(person)
            os.close(terminal)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedArm]:
    folder = tmp_path_factory.mktemp("served")
    config = folder / "roboneuron.toml"
    config.write_text(CONFIG.format(bound_s=BOUND_S, state=folder / "state"))
    with pytest.MonkeyPatch.context() as patch, ExitStack() as stack:
        patch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
        prepare_environment(folder / "log")
        options = ("--log-level", "error")
        agent = blocking_client(config, os.environ, *options)
        served = ServedArm(*stack.enter_context(agent), folder / "state")
        stack.callback(served.link.close)
        served.do("start_robot")
        yield served


def test_a_frozen_server_ends_a_direct_motion(arm: ServedArm, wait: Wait) -> None:
    wait(arm.is_still, 10.0, "the arm stands at first")
    server = int(arm.do("get_status")["pid"])
    call = arm.move_away()
    arm.wait_moving()
    frozen_s = time.time()
    os.kill(server, signal.SIGSTOP)
    try:
        wait(arm.is_still, 5.0, "the arm stands though its trajectory goes on for seconds")
        assert 0.0 < arm.last_moving_s - frozen_s < BOUND_S + BRAKING_S
        place = arm.position.copy()
        time.sleep(1.0)  # to show that nothing happens
        assert np.abs(arm.position - place).max() < 0.01
        assert abs(place[6]) < 1.9, "it was on its way"
    finally:
        os.kill(server, signal.SIGCONT)
    call.join(30.0)
    assert not call.is_alive()
    assert np.abs(arm.position - place).max() < 0.01, (
        "a server that lives again does not take the motion up again"
    )
    wait(lambda: "no sign of life" in arm.robot()["note"], 3.0, "the status says why")
    arm.moves_to(float(place[6]) + 0.2)


def test_a_frozen_robot_ends_a_direct_motion_by_its_name(arm: ServedArm, wait: Wait) -> None:
    wait(arm.is_still, 10.0, "the arm stands at first")
    call = arm.move_away()
    arm.wait_moving()
    robot = int(arm.robot()["pid"])
    os.kill(robot, signal.SIGSTOP)
    try:
        call.join(5.0)
        assert not call.is_alive(), "the call ends while its robot is frozen"
        assert "robot is frozen" in arm.told
        again = arm.answer("move_joints", positions={"fr3_joint7": 0.0})
        assert again.is_error
        assert again.meta["roboneuron/error"]["code"] == "not_ready"
    finally:
        os.kill(robot, signal.SIGCONT)
    wait(lambda: bool(arm.robot()["needs_start"]), 5.0, "the status says why it keeps still")
    wait(arm.is_still, 3.0, "the arm brakes")
    place = arm.position.copy()
    time.sleep(1.0)  # to show that nothing happens
    assert np.abs(arm.position - place).max() < 0.01
    arm.moves_to(float(place[6]) * 0.9)


def test_a_removed_state_directory_does_not_release_the_stop(arm: ServedArm, wait: Wait) -> None:
    call = arm.move_away()
    arm.wait_moving()
    arm.do("emergency_stop", reason="a hand in the workspace")
    call.join(30.0)
    wait(arm.is_still, 3.0, "the arm stands")
    place = arm.position.copy()
    arm.lose_state()
    wait((arm.state / ESTOP_FILE).exists, 2.0, "the latch is written again")
    answer = arm.answer("move_joints", positions={"fr3_joint7": -float(np.sign(place[6]))})
    assert answer.is_error
    assert "latched" in answer.content[0].text
    assert json.loads((arm.state / ESTOP_FILE).read_text())["restored"] >= 1
    time.sleep(1.0)  # to show that nothing happens
    assert np.abs(arm.position - place).max() < 0.02
    status = arm.do("get_status")
    assert status["emergency_stop"] is True
    assert "vanished without a reset" in status["emergency_stop_cause"]
    incidents = arm.do("list_incidents")["incidents"]
    assert ("emergency_stop", "latch_vanished") in {(i["module"], i["what"]) for i in incidents}

    refused = arm.answer("reset_emergency_stop")
    assert refused.is_error
    assert "Only a person releases" in refused.content[0].text
    arm.release()
    wait(lambda: not arm.do("get_status")["emergency_stop"], 3.0, "it is released")
    target = float(place[6]) - 0.2 * float(np.sign(place[6]))
    arm.moves_to(target)


def test_a_removed_state_directory_during_motion_stops_nothing_and_hides_no_stop(
    arm: ServedArm, wait: Wait
) -> None:
    """Nothing is latched when it is removed; a later stop must still hold."""
    call = arm.move_away()
    arm.wait_moving()
    arm.lose_state()
    arm.do("emergency_stop", reason="smoke")
    call.join(30.0)
    wait(arm.is_still, 3.0, "the arm stands")
    assert (arm.state / ESTOP_FILE).exists()
    arm.release()
    wait(lambda: not arm.do("get_status")["emergency_stop"], 3.0, "it is released")


def test_a_foreign_node_cannot_deactivate_the_robot(arm: ServedArm, wait: Wait) -> None:
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters

    value = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=True)
    simulated = Parameter(name="use_sim_time", value=value)
    requests = [
        (
            ChangeState,
            "change_state",
            ChangeState.Request(transition=Transition(id=4, label="deactivate")),
        ),
        (
            SetParameters,
            "set_parameters",
            SetParameters.Request(parameters=[simulated]),
        ),
    ]

    def count() -> int:
        return int(arm.robot()["dropped_by"].get("foreign_request", 0))

    def send(service_type: Any, name: str, request: Any) -> None:
        path = f"/fr3/robot/{name}"
        wait(lambda: arm.link.is_service_ready(service_type, path), 10.0, "the service is found")
        call = arm.link.call(service_type, path, request, lambda: None)
        wait(call.done, 5.0, "it is answered")
        assert "successful=True" not in str(call.result())
        assert "success=True" not in str(call.result())

    def is_named() -> bool:
        """Ask again until the robot has discovered the node that asks; it tells once a second."""
        if "/witness" in arm.robot()["metrics"]["foreign_request"]:
            return True
        send(*requests[0])
        return False

    before = count()
    for request in requests:
        send(*request)
    wait(lambda: count() == before + 2, 5.0, "both are counted")
    # a report may be late on a busy machine
    wait(lambda: arm.robot()["health"] == "ok", 10.0, "the robot is well")
    robot = arm.robot()
    assert robot["state"] == "active"
    wait(is_named, 20.0, "the robot names the node that asks")
    assert any(i["what"] == "foreign_request" for i in arm.do("list_incidents")["incidents"])
