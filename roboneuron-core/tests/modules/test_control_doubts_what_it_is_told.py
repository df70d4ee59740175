"""Faults in joint states, clocks and commands, judged by control's commands and reports."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from rn_standard.control import module as control_module
from rn_testing.waiting import holds_within
from roboneuron.contract import JointSample
from roboneuron.modules import holding
from roboneuron.modules.settings import SERVER_SILENT
from roboneuron.ros.messages import to_action_message, to_joint_state

pytestmark = pytest.mark.ros
FORWARD = np.array([0.01, 0, 0, 0, 0, 0, 1.0])
TIMEOUT_S = 0.25
"""Default of control.state_timeout_s."""


class Cell:
    """Control, with joint states from a timer that a test can change, and publishers of a policy
    and a foreign node.
    """

    def __init__(self, world: Any, **options: Any) -> None:
        self.world = world
        self.position = np.array([0.5, -0.5])
        self.names: tuple[str, ...] = ("a", "b")
        self.shift_ns = 0
        self.frozen_ns = 0
        self.commands = world.listen(JointTrajectory, "joint_trajectory")
        self.control = world.start("control", **options)
        self.states = world.publisher(JointState, "joint_states")
        self.stranger = world.publisher(JointState, "joint_states")
        self.actions = world.publisher(Float64MultiArray, "action")
        self.timer = world.node.create_timer(0.01, self.send_state)
        assert holds_within(lambda: self.value("ready") == "true")

    def state(self, **changes: Any) -> JointState:
        now_ns = self.frozen_ns or self.world.node.get_clock().now().nanoseconds + self.shift_ns
        values = {
            "names": self.names,
            "position": self.position.copy(),
            "stamp_ns": now_ns,
        } | changes
        return to_joint_state(JointSample(**values))

    def send_state(self) -> None:
        self.states.publish(self.state())

    def value(self, key: str) -> str:
        message = self.control.status.to_message()
        return next((pair.value for pair in message.values if pair.key == key), "")

    def count(self, key: str) -> int:
        return int(self.value(key) or 0)

    def act(self, vector: np.ndarray = FORWARD) -> None:
        self.actions.publish(to_action_message(vector))

    def follows(self) -> bool:
        """Whether control follows an action, or one of a few: on a busy machine one may be late."""
        before = len(self.commands)

        def is_followed() -> bool:
            sent = self.commands[before:]
            return any(one.points[0].positions[0] > self.position[0] + 1e-3 for one in sent)

        for _ in range(10):
            self.act()
            if holds_within(is_followed, 2.0):
                return True
        return False

    def last(self) -> list[float]:
        return list(self.commands[-1].points[0].positions)


@pytest.fixture
def cell(world: Any) -> Cell:
    return Cell(world)


FAULTS: dict[str, Callable[[Cell], None]] = {
    "stale": lambda cell: setattr(cell, "shift_ns", -1_000_000_000),
    "future": lambda cell: setattr(cell, "shift_ns", 3_600_000_000_000),
    "frozen": lambda cell: setattr(
        cell, "frozen_ns", cell.world.node.get_clock().now().nanoseconds
    ),
    "unstamped": lambda cell: setattr(cell, "frozen_ns", 1),
    "missing-joint": lambda cell: (
        setattr(cell, "names", ("a",)),
        setattr(cell, "position", np.array([0.5])),
    )[0],
    "unknown-names": lambda cell: setattr(cell, "names", ("c", "d")),
    "nan": lambda cell: setattr(cell, "position", np.array([0.5, np.nan])),
    "infinity": lambda cell: setattr(cell, "position", np.array([-np.inf, 0.0])),
    "silent": lambda cell: cell.world.run(cell.timer.cancel),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_joint_states_with_a_fault_end_the_commands_until_the_arm_can_be_held_where_it_is(
    cell: Cell, fault: str
) -> None:
    # it continues; only the states are faulty
    policy = cell.world.node.create_timer(0.03, cell.act)
    assert holds_within(lambda: len(cell.commands) > 1)
    assert cell.last()[0] > 0.5
    FAULTS[fault](cell)
    assert holds_within(lambda: cell.value("hold_code") == "stale_joint_state")
    time.sleep(0.05)
    count = len(cell.commands)
    assert holds_within(lambda: cell.count("dropped.stale_joint_state") > 0)
    assert not holds_within(lambda: len(cell.commands) > count, 0.2), (
        "nothing leads back to an old posture"
    )
    cell.world.run(policy.cancel)
    if fault not in ("silent", "frozen"):
        assert cell.count("dropped.bad_joint_state") > 0
    cell.names, cell.position, cell.shift_ns, cell.frozen_ns = (
        ("a", "b"),
        np.array([0.51, -0.5]),
        0,
        0,
    )
    cell.timer.reset()
    assert holds_within(lambda: len(cell.commands) == count + 1)
    assert cell.last() == pytest.approx([0.51, -0.5])


STRANGE: dict[str, dict[str, Any]] = {
    "nan": {"position": np.array([np.nan, np.nan])},
    "elsewhere": {"position": np.array([-0.9, 0.9])},
    "unknown-names": {"names": ("c", "d")},
    "missing-joint": {"names": ("b",), "position": np.array([-0.5])},
    "future": {"stamp_ns": 2**62},
    "old": {"stamp_ns": 1},
}


@pytest.mark.parametrize("fault", STRANGE)
def test_bad_joint_states_of_a_stranger_are_counted_and_do_not_matter(
    cell: Cell, fault: str
) -> None:
    for _ in range(20):
        cell.stranger.publish(cell.state(**STRANGE[fault]))
        time.sleep(0.005)
    assert holds_within(lambda: cell.count("dropped.bad_joint_state") > 0)
    assert cell.follows()
    assert cell.commands[0].points[0].positions[0] == pytest.approx(0.51, abs=1e-6)


def test_reordered_joint_states_do_not_bring_an_old_posture_back(cell: Cell) -> None:
    cell.position = np.array([0.52, -0.5])
    time.sleep(0.05)
    now_ns = cell.world.node.get_clock().now().nanoseconds
    for _ in range(20):
        cell.stranger.publish(
            cell.state(position=np.array([0.48, -0.5]), stamp_ns=now_ns - 100_000_000)
        )
        time.sleep(0.005)
    assert holds_within(lambda: cell.count("dropped.bad_joint_state") > 0)
    assert cell.follows()
    assert cell.commands[0].points[0].positions[0] == pytest.approx(0.53, abs=1e-6)


@pytest.mark.parametrize("jump_s", [-0.2, 0.2], ids=["back", "forward"])
def test_stamps_of_a_robot_whose_clock_jumps_stop_the_arm_for_one_timeout_only(
    cell: Cell, jump_s: float
) -> None:
    assert cell.follows()
    cell.shift_ns = int(jump_s * 1e9)
    assert cell.follows()


def test_server_that_is_frozen_stops_the_arm_until_it_asks_for_motion_again(world: Any) -> None:
    """Without a server there are no heartbeats, and no requests."""
    new = "action_timeout_s = 0.3\nserver_timeout_s = 0.3"
    cell = Cell(world, replace={"action_timeout_s = 0.3": new})
    policy = cell.world.node.create_timer(0.03, cell.act)
    assert holds_within(lambda: len(cell.commands) > 20)
    for _ in range(2):
        cell.control.note_beat()
        if cell.control.needs_start:
            count = len(cell.commands)
            assert not holds_within(lambda count=count: len(cell.commands) > count, 0.2), (
                "its life starts nothing"
            )
            cell.control.note_beat()
            cell.world.permit(cell.control)
        before, dropped = len(cell.commands), cell.count("dropped.server_silent")
        assert holds_within(lambda before=before: len(cell.commands) > before + 3)
        assert holds_within(
            lambda dropped=dropped: cell.count("dropped.server_silent") > dropped + 5
        )
        assert cell.value("hold_code") == "server_silent"
        count = len(cell.commands)
        assert not holds_within(lambda count=count: len(cell.commands) > count, 0.2)
    cell.world.run(policy.cancel)


@pytest.mark.parametrize("kind", ["robot", "inference", "control"])
def test_a_module_whose_process_was_frozen_needs_a_new_start(
    world: Any, status_of: Any, kind: str
) -> None:
    node = world.start(kind)
    for stops in (1, 2):
        node.note_resumed()
        assert node.is_server_silent(), "at once, though the executor has not run since"
        assert holds_within(lambda stops=stops: node.stops == stops)
        assert not node.is_server_silent()
        assert status_of(node)["needs_start"] == f"the {kind} process was frozen"


def test_a_control_that_was_frozen_needs_a_new_start_though_the_server_is_heard_first(
    world,
) -> None:
    """The thread that reads the heartbeats resumes before the executor does."""
    cell = Cell(
        world,
        replace={"action_timeout_s = 0.3": "action_timeout_s = 0.3\nserver_timeout_s = 0.4"},
    )
    beats = cell.world.node.create_timer(0.03, cell.control.note_beat)
    policy = cell.world.node.create_timer(0.03, cell.act)
    assert holds_within(lambda: len(cell.commands) > 5)

    def freeze() -> None:
        time.sleep(0.8)
        cell.control.note_beat()

    cell.world.run(freeze)
    assert holds_within(lambda: cell.control.needs_start == SERVER_SILENT), "it goes on by itself"
    count = len(cell.commands)
    assert not holds_within(lambda: len(cell.commands) > count + 1, 0.4), (
        "one command may have been on its way"
    )
    cell.world.permit(cell.control)
    assert holds_within(lambda: len(cell.commands) > count + 5)
    beats.cancel()
    cell.world.run(policy.cancel)


def test_a_silence_while_a_module_was_loading_is_no_stop(world) -> None:
    """Imports may block every thread of a process; nothing moved meanwhile."""
    # long enough for a busy machine between two signs of life
    control = world.module("control", replace={"action_timeout_s = 0.3": "server_timeout_s = 2.0"})
    control.note_beat()
    kind = control._kind

    def load(node):
        time.sleep(2.2)
        control.note_beat()
        return kind(node)

    control._kind = load
    world.run(control.trigger_configure)
    assert not control.needs_start
    world.run(lambda: None)
    assert not control.needs_start


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Return a function that shifts control's wall clock against that of the publishers."""

    class Shifted:
        monotonic = staticmethod(time.monotonic)
        shift_ns = 0

        @classmethod
        def time_ns(cls) -> int:
            return time.time_ns() + cls.shift_ns

    for module in (control_module, holding):
        monkeypatch.setattr(module, "time", Shifted)
    return lambda seconds: setattr(Shifted, "shift_ns", int(seconds * 1e9))


@pytest.mark.parametrize(
    ("jump_s", "word"),
    [
        (10.0, "stale_action"),
        (-10.0, "future_action"),
        (3e7, "stale_action"),
        (-3e7, "future_action"),
    ],
)
def test_clock_that_jumps_stops_actions_and_lets_them_through_once_it_is_right(
    world: Any, clock: Callable[[float], None], jump_s: float, word: str
) -> None:
    # on a busy machine an action, or the states, came later than within the usual 0.3 s
    cell = Cell(
        world, replace={"action_timeout_s = 0.3": "action_timeout_s = 2.0\nstate_timeout_s = 2.0"}
    )
    cell.act()
    assert holds_within(lambda: len(cell.commands) == 1)
    clock(jump_s)
    cell.act()
    assert holds_within(lambda: cell.count(f"dropped.{word}") > 0)
    assert holds_within(lambda: len(cell.commands) == 2)
    assert cell.value("hold_code") == "no_action"
    assert cell.last() == pytest.approx([0.5, -0.5])
    clock(0.0)
    cell.act()
    assert holds_within(lambda: len(cell.commands) == 3)


def test_clock_set_back_on_the_whole_machine_does_not_forbid_newer_actions(cell: Cell) -> None:
    """An action was accepted with a stamp one hour ahead; later ones have smaller stamps."""
    cell.control.module.action_ns = time.time_ns() + 3_600_000_000_000
    cell.act()
    assert holds_within(lambda: len(cell.commands) == 1)


def test_limits_are_applied_counted_reported_and_audited(world: Any) -> None:
    cell = Cell(world, extra="[limits]\nvelocity_fraction = 0.05\n")
    cell.act(np.array([0.09, 0, 0, 0, 0, 0, 1.0]))
    assert holds_within(lambda: len(cell.commands) == 1)
    moved = cell.last()[0] - 0.5
    assert 0.0 < moved <= 0.05 * 0.1 + 1e-9
    assert cell.count("limited.velocity") == 1
    assert float(cell.value("asked_joint_speed")) == pytest.approx(0.9, rel=1e-3)
    assert float(cell.value("sent_joint_speed")) == pytest.approx(0.05, rel=1e-3)
    assert "allowed is 0.05" in cell.value("limit")
    lines = (world.state_directory / "audit.jsonl").read_text().splitlines()
    record = json.loads(lines[-1])
    assert (record["who"], record["verdict"]) == ("control", "scaled")
    assert record["arguments"]["asked"]["joint_speed"] > record["arguments"]["sent"]["joint_speed"]


def test_limit_that_holds_commands_the_measured_posture(world: Any) -> None:
    cell = Cell(world, extra='[limits]\nvelocity_fraction = 0.5\non_velocity = "hold"\n')
    cell.act(np.array([0.01, 0, 0, 0, 0, 0, 1.0]))
    assert holds_within(lambda: len(cell.commands) == 1)
    cell.position = np.array([0.505, -0.5])
    time.sleep(0.05)
    cell.act(np.array([0.09, 0, 0, 0, 0, 0, 1.0]))
    assert holds_within(lambda: len(cell.commands) == 2)
    assert cell.last() == pytest.approx([0.505, -0.5])
    assert cell.count("dropped.limit_velocity") == 1
    assert cell.value("hold_code") == "limit_velocity"


def test_limit_that_refuses_sends_nothing(world: Any) -> None:
    cell = Cell(world, extra='[limits]\nvelocity_fraction = 0.5\non_velocity = "refuse"\n')
    cell.act(np.array([0.09, 0, 0, 0, 0, 0, 1.0]))
    assert holds_within(lambda: cell.count("dropped.limit_velocity") == 1)
    assert not cell.commands


def test_limits_that_do_not_fit_the_robot_refuse_to_start(world: Any) -> None:
    zone = '[[limits.zones]]\nname = "vase"\nlower_m = [1.0, 0.0, 0.0]\nupper_m = [0.0, 1.0, 1.0]\n'
    node = world.module("control", extra=zone)
    world.run(node.trigger_configure)
    assert "'vase'" in node.status.to_message().message
