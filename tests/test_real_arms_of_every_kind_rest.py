"""Two arms behind ros2_control in one server, one with a gripper, the other one on a rail, with
joints that turn without end, and without a gripper: each starts, moves, keeps to its limits, rests
when it is stopped or its call is cancelled, and the other one goes on.

Judged by the joint states of the two controllers, which are processes of their own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import gantry_plugin as gantry
from cancel_wire import TOKENS, HttpClient, Way, answered, served
from plugin_site import installed

sys.path.pop(0)
sys.path.pop(0)

from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT
from rn_robot_fr3.profile import HOME_RAD
from rn_testing.spinning import spinning_node
from rn_testing.waiting import holds_within, wait_until
from roboneuron.ros.environment import prepare_environment

pytestmark = [pytest.mark.ros, pytest.mark.exhaustive, pytest.mark.timeout(240)]
NEWEST = "2026-07-28"
REST_S = 3.0
"""Deceleration, the window in which rest is measured, and a busy machine."""
WINDOW_S, STILL, MOVES = 0.3, 0.002, 0.01
CONFIG = """
[robots.left]
robot = {{ name = "fr3", driver = "ros2-control" }}
[robots.left.control]
controller = "urdf"
[robots.left.plugins.fr3]
controller = "/left_controller"
joint_states = "/left_cell/joint_states"
gripper = "gripper-command"
gripper_action = "/left_gripper/gripper_cmd"
connect_timeout_s = 60.0
state_timeout_s = 3.0
[robots.right]
robot = {{ name = "gantry", driver = "ros2-control" }}
[robots.right.control]
controller = "urdf"
[robots.right.plugins.gantry]
controller = "/right_controller"
joint_states = "/right_cell/joint_states"
connect_timeout_s = 60.0
state_timeout_s = 3.0
[[robots.right.expose]]
name = "follow"
kind = "action"
topic = "/right_controller/follow_joint_trajectory"
type = "control_msgs/action/FollowJointTrajectory"
[supervisor]
state_directory = "{folder}/state"
"""
ARMS: dict[str, tuple[Sequence[str], Sequence[float]]] = {
    "left": (ARM_JOINTS, [float(q) for q in HOME_RAD]),
    "right": (gantry.JOINTS, gantry.HOME),
}
OTHER = {"left": "right", "right": "left"}
ENDS: dict[str, tuple[str, float, float]] = {
    "left": ("fr3_joint1", -0.7, 0.7),
    "right": ("rail", 0.1, 1.1),
}
"""A joint of each arm, and two places of which the farther one is far enough."""
BEYOND: dict[str, dict[str, float]] = {
    "left": {"fr3_joint1": 3.5},
    "right": {"rail": 1.5},
}


class Cell:
    """Both controllers, what they measure, and a server.

    Attributes:
        steward: a client.
        seen: by arm, the measured joints with the time of their arrival [monotonic s].
    """

    def __init__(self, url: str, node: Any) -> None:
        from sensor_msgs.msg import JointState

        self.url = url
        self.steward = HttpClient(url, "2025-11-25")
        self.seen: dict[str, list[tuple[float, dict[str, float]]]] = {arm: [] for arm in ARMS}
        for arm in ARMS:

            def take(message: Any, arm: str = arm) -> None:
                joints = dict(zip(message.name, message.position, strict=True))
                self.seen[arm].append((time.monotonic(), joints))

            node.create_subscription(JointState, f"/{arm}_cell/joint_states", take, 50)

    def place(self, arm: str, joint: str) -> float:
        """The newest measurement of a joint."""
        return self.seen[arm][-1][1][joint]

    def _travel(self, arm: str) -> float:
        since_s = time.monotonic() - WINDOW_S
        inside = [joints for at_s, joints in self.seen[arm][-200:] if at_s > since_s]
        if len(inside) < 5:
            return float("nan")
        return max(
            max(values) - min(values) for values in zip(*map(dict.values, inside), strict=True)
        )

    def moves(self, arm: str) -> bool:
        return self._travel(arm) > MOVES

    def rests(self, arm: str) -> bool:
        return self._travel(arm) < STILL

    def far(self, arm: str) -> dict[str, Any]:
        """A long motion of an arm; the joint without end turns on."""
        joint, *ends = ENDS[arm]
        target = max(ends, key=lambda end: abs(end - self.place(arm, joint)))
        positions = {joint: target}
        if arm == "right":
            positions["turn"] = self.place(arm, "turn") + 2.0
        return {"robot": arm, "positions": positions, "duration_s": 8.0}

    def goal(self) -> dict[str, Any]:
        """The same as a goal for the controller of the right arm."""
        joints = self.seen["right"][-1][1] | self.far("right")["positions"]
        point = {"positions": list(joints.values()), "time_from_start": 8.0}
        return {
            "robot": "right",
            "goal": {"trajectory": {"joint_names": list(joints), "points": [point]}},
            "timeout_s": 60.0,
        }

    @contextmanager
    def begun(self, arm: str, tool: str = "move_joints") -> Iterator[HttpClient]:
        """A client whose call moves the arm."""
        client = HttpClient(self.url, NEWEST)
        client.number += 100 * list(ARMS).index(arm)  # an id that two calls have cancels neither
        client.begin(tool, self.far(arm) if tool == "move_joints" else self.goal())
        try:
            assert holds_within(lambda: self.moves(arm), 30.0), client.said()[-2000:]
            yield client
        finally:
            client.leave_call()


@contextmanager
def controller(folder: Path, arm: str) -> Iterator[None]:
    """The stand-in of a real arm's controller; the left one has a gripper."""
    joints, start = ARMS[arm]
    command = [
        *(sys.executable, "-m", "rn_driver_ros2control.standin_node"),
        *("--controller", f"/{arm}_controller", "--joint-states", f"/{arm}_cell/joint_states"),
        *("--joints", *joints, "--start", *map(str, start)),
    ]
    if arm == "left":
        command += [
            "--gripper-joint",
            FINGER_JOINT,
            "--gripper-action",
            "/left_gripper/gripper_cmd",
        ]
    with (
        (folder / f"{arm}.log").open("wb") as log,
        subprocess.Popen(command, stdout=log, stderr=log) as process,
    ):
        try:
            yield
        finally:
            process.terminate()


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    folder = tmp_path_factory.mktemp("arms")
    with ExitStack() as stack:
        stack.enter_context(
            installed(folder, "gantry-plugin", (gantry.PLUGIN,), source=Path(__file__).parent)
        )
        prepare_environment(folder / "ros")
        for arm in ARMS:
            stack.enter_context(controller(folder, arm))
        configuration = folder / "arms.toml"
        configuration.write_text(CONFIG.format(folder=folder) + TOKENS)
        environment = {**os.environ, "XDG_STATE_HOME": str(folder)}
        _, url = stack.enter_context(served(configuration, environment, transport="http"))
        made = Cell(url, stack.enter_context(spinning_node("judge")))
        for arm in ARMS:
            for kind in ("robot", "control"):
                made.steward.call(f"start_{kind}", {"robot": arm})
        yield made


arms = pytest.mark.parametrize("arm", [pytest.param("left", marks=pytest.mark.exhaustive), "right"])


@arms
def test_the_tcp_moves_and_only_a_gripper_takes_an_opening(cell: Cell, arm: str) -> None:
    told = cell.steward.call("move_ee", {"robot": arm, "dz_m": 0.03, "duration_s": 2.0})
    assert told["error_m"] < 0.003
    opened = {"robot": arm, "dz_m": -0.03, "duration_s": 2.0, "gripper_open": 0.5}
    if arm == "left":
        assert cell.steward.call("move_ee", opened)["error_m"] < 0.003
        wait_until(lambda: cell.place(arm, FINGER_JOINT) < 0.03, 10.0, "the fingers close")
        return
    wait_until(lambda: cell.rests(arm), 5.0, "rest after the first motion")
    told = cell.steward.failure("move_ee", opened)
    assert (told["code"], told["path"]) == ("invalid_input", "gripper_open")
    assert not holds_within(lambda: cell.moves(arm), 0.5), "a refused call moves the arm"


@arms
def test_joints_of_each_kind_keep_to_their_limits(cell: Cell, arm: str) -> None:
    for joint, beyond in BEYOND[arm].items():
        told = cell.steward.failure(
            "move_joints", {"robot": arm, "positions": {joint: beyond}, "duration_s": 5.0}
        )
        assert told["code"] in ("invalid_input", "unsafe", "refused"), told
    joint, _, there = ENDS[arm]
    fast = {
        "joint_names": [joint],
        "points": [{"positions": [there], "time_from_start": 0.05}],
    }
    told = cell.steward.failure("publish_joint_trajectory", {"robot": arm, "message": fast})
    assert told["code"] in ("invalid_input", "unsafe", "refused"), told
    assert not holds_within(lambda: cell.moves(arm), 0.5), "a refused command moves the arm"


def test_a_joint_without_end_turns_the_shorter_way(cell: Cell) -> None:
    for target in (2.8, -2.8):
        motion = {"robot": "right", "positions": {"turn": target}, "duration_s": 3.0}
        cell.steward.call("move_joints", motion)
    turned = [joints["turn"] for _, joints in cell.seen["right"]]
    assert max(abs(one - other) for one, other in pairwise(turned)) < 0.3, "it jumps"
    back = turned[-1]
    assert abs(back) == pytest.approx(2.8, abs=0.02) or back == pytest.approx(3.483, abs=0.02)
    cell.steward.call(
        "move_joints", {"robot": "right", "positions": {"turn": 0.0}, "duration_s": 4.0}
    )


@arms
@pytest.mark.parametrize(
    "way",
    ["stop_motion", "notification", pytest.param("stream closed", marks=pytest.mark.exhaustive)],
)
def test_one_arm_rests_and_the_other_goes_on(cell: Cell, arm: str, way: str) -> None:
    with cell.begun(arm) as client, cell.begun(OTHER[arm]) as other:
        if way == "stop_motion":
            assert cell.steward.call(way, {"robot": arm})["at_rest"] is True
        else:
            assert client.cancel(cast(Way, way)) == answered("http", NEWEST, cast(Way, way))
        wait_until(lambda: cell.rests(arm), REST_S, "rest")
        assert holds_within(lambda: cell.moves(OTHER[arm]), 2.0)
        assert not holds_within(lambda: cell.moves(arm), 0.5), "it moves again"
        wait_until(other.has_answered, 30.0, "the other one arrives")
        assert other.has_succeeded(), other.said()[-2000:]


@pytest.mark.parametrize(
    "way",
    [
        "stop_motion",
        *(
            pytest.param(way, marks=pytest.mark.exhaustive)
            for way in ("notification", "stream closed")
        ),
    ],
)
def test_a_goal_that_the_controller_carries_out_is_ended_too(cell: Cell, way: str) -> None:
    with cell.begun("right", "send_follow_goal") as client:
        if way == "stop_motion":
            cell.steward.call(way, {"robot": "right"})
        else:
            assert client.cancel(cast(Way, way)) == answered("http", NEWEST, cast(Way, way))
        wait_until(lambda: cell.rests("right"), REST_S, "rest")
        assert not holds_within(lambda: cell.moves("right"), 0.5), "it moves again"


def test_one_stop_motion_rests_both_arms(cell: Cell) -> None:
    with cell.begun("left") as left, cell.begun("right", "send_follow_goal") as right:
        cell.steward.call("stop_motion", {})
        for arm, client in (("left", left), ("right", right)):
            wait_until(lambda arm=arm: cell.rests(arm), REST_S, "rest")
            wait_until(client.has_answered, 10.0, "the call ends")
            assert not client.has_succeeded()
        assert not holds_within(lambda: any(map(cell.moves, ARMS)), 0.5), "one moves again"
