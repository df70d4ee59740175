"""Whatever a module that commands an arm requests, in any state, no command exceeds the limits."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from inspect import getattr_static
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from control_cell import ARM, START, STATE_TIMEOUT_S, MakeHost
from loop_plugin import Adder
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from roboneuron.contract import Hold, JointCommand, JointSample
from roboneuron.errors import InvalidInputError, UnsafeError
from roboneuron.gate.motion.command import Asked
from roboneuron.modules.holding import HoldingModule
from roboneuron.modules.module_host import ModuleHost
from roboneuron.moved import Moved
from roboneuron.ros.graph import server_node

STEP_S = 0.1
FASTEST = 0.5
"""Speed limit of each joint [rad/s]: the profile allows 1.0, the configuration half of it."""


class Hostile(HoldingModule):
    """A feature's module that sends anything through everything that its base class lends it."""

    def __init__(self, node: Any) -> None:
        super().__init__(node)
        self.limit_with(Adder(None, self.profile))
        self.activate()

    def ask(self, position: list[float], *, age_s: float = 0.0, **changes: Any) -> None:
        values: dict[str, Any] = {"names": ARM, "position": position, "duration_s": STEP_S}
        command = JointCommand(**(values | changes))
        source_ns = self.node.now_ns() - round(age_s * 1e9)
        self.act(source_ns, lambda: Asked(now=lambda joints, step_s, now_s: command))


class Cell:
    """A hostile module whose arm stands at START, with its sent messages."""

    def __init__(self, make_host: MakeHost, **options: Any) -> None:
        self.host = make_host("control", extra="[limits]\nvelocity_fraction = 0.5\n", **options)
        self.position = START
        self.module = Hostile(self.host)
        self.measure()

    def measure(self) -> None:
        joints = JointSample(names=ARM, position=self.position, stamp_ns=self.host.clock.wall_ns)
        self.module.believe(joints, self.host.clock.now_s)

    @property
    def sent(self) -> list[list[float]]:
        """Positions of every message to the joints."""
        return [
            list(message.points[0].positions)
            for message in self.host.publishers["joint_trajectory"].messages
        ]


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


@pytest.mark.parametrize("jump", [[3.0, -0.5], [0.5, -40.0], [0.9, -0.9], [1.01, -0.5]])
def test_a_jump_is_cut_to_what_the_limits_allow(cell: Cell, jump: list[float]) -> None:
    """The arm follows exactly: half of each command has passed when the next one comes."""
    refused = 0
    for _ in range(30):
        before = len(cell.sent)
        cell.module.ask(jump)
        for position in cell.sent[before:]:
            step = np.array(position) - cell.position
            assert np.abs(step).max() <= FASTEST * STEP_S + 1e-9
            assert np.abs(position).max() <= 1.0, "the profile's limit"
            cell.position = cell.position + step / 2
        refused += len(cell.sent) == before
        cell.host.clock.go(STEP_S / 2)
        cell.measure()
    if max(np.abs(jump)) <= 1.0:
        assert cell.position.tolist() == pytest.approx(jump, abs=0.01)
    else:
        assert refused, "it would end beyond a joint's travel"


def test_what_is_planned_is_limited_too(make_host: MakeHost) -> None:
    """Rows planned ahead are limited like the current one."""
    cell = Cell(
        make_host, replace={"action_timeout_s = 0.3": "action_timeout_s = 0.8\nhorizon_s = 0.5"}
    )

    def ask(*positions: list[float]) -> list[list[float]]:
        def answer(position: list[float]) -> Callable[..., JointCommand]:
            return lambda *_: JointCommand(
                names=ARM, position=np.array(position), duration_s=STEP_S
            )

        now, *later = map(answer, positions)
        asked = Asked(now=now, later=tuple(later), step_s=STEP_S)
        cell.module.act(cell.host.clock.wall_ns, lambda: asked)
        message = cell.host.publishers["joint_trajectory"].messages[-1]
        assert message.header.frame_id == server_node(os.getppid())
        return [list(point.positions) for point in message.points]

    jumps = np.array([START, *ask([0.505, -0.5], [0.9, -0.9], [-0.9, 0.9])])
    assert len(jumps) == 4
    assert np.abs(np.diff(jumps, axis=0)).max() <= FASTEST * STEP_S + 1e-9
    cell.host.clock.go(STEP_S)
    cell.measure()
    for beyond in ([3.0, -0.5], [math.nan, -0.5], [math.inf, -0.5]):
        points = ask([0.505, -0.5], [0.51, -0.5], beyond, [0.52, -0.5])
        assert len(points) == 2, "the plan ends before it"


@pytest.mark.parametrize(
    ("asked", "word"),
    [
        ({"position": [math.nan, -0.5]}, "unsafe_command"),
        ({"position": [0.5, math.inf]}, "unsafe_command"),
        ({"position": [0.5, -0.5], "names": ("a", "z")}, "unsafe_command"),
        ({"position": [0.5, -0.5], "duration_s": math.nan}, "unsafe_command"),
        ({"position": [0.5, -0.5], "duration_s": 0.0}, "unsafe_command"),
        ({"position": [0.5, -0.5], "duration_s": 1e6}, "long_command"),
    ],
)
def test_what_is_no_command_is_not_sent(cell: Cell, asked: dict[str, Any], word: str) -> None:
    cell.module.ask(**asked)
    assert cell.sent == []
    assert cell.host.drops() == {word: 1}


STOPS: dict[str, Callable[[Cell], object]] = {
    "emergency_stop": lambda cell: setattr(cell.host, "stopped", True),
    "server_silent": lambda cell: setattr(cell.host, "silence_s", math.inf),
    "needs_new_start": lambda cell: setattr(cell.host, "needs_start", "a stop"),
    "stale_joint_state": lambda cell: cell.host.clock.go(STATE_TIMEOUT_S + 0.01),
}


@pytest.mark.parametrize("word", STOPS)
def test_while_the_arm_must_hold_nothing_is_sent(cell: Cell, word: str) -> None:
    STOPS[word](cell)
    cell.module.ask([0.51, -0.5])
    assert cell.sent == []
    assert cell.host.drops() == {word: 1}


@pytest.mark.parametrize("word", STOPS)
def test_a_stop_during_the_work_is_in_time(cell: Cell, word: str) -> None:
    def answer(*_: object) -> JointCommand:
        STOPS[word](cell)
        return JointCommand(names=ARM, position=START + 0.01, duration_s=STEP_S)

    cell.module.act(cell.host.clock.wall_ns, lambda: Asked(now=answer))
    assert cell.sent == []
    assert cell.host.drops()[word] == 1


def test_after_an_emergency_stop_only_the_hold_leaves(cell: Cell) -> None:
    cell.module.ask([0.505, -0.5])
    assert len(cell.sent) == 1
    cell.host.stopped = True
    cell.module.stop("emergency_stop")
    assert cell.sent[1:] == [list(START)], "held where it is measured"
    for _ in range(3):
        cell.host.clock.go(0.02)
        cell.measure()
        cell.module.ask([0.51, -0.5])
    assert len(cell.sent) == 2


def test_what_was_held_up_or_is_not_ours_is_not_sent(cell: Cell, make_host: MakeHost) -> None:
    cell.module.ask([0.505, -0.5], age_s=0.4)
    cell.host.handover.set("act_until_ns", cell.host.clock.wall_ns)
    cell.module.ask([0.505, -0.5])
    cell.host.handover.set("act_until_ns", 0)
    cell.module.deactivate()
    cell.module.ask([0.505, -0.5])
    shadow = Cell(make_host, is_successor=True)
    shadow.module.ask([0.505, -0.5])
    assert (cell.sent, shadow.sent) == ([], [])


def test_an_input_that_cannot_be_read_is_counted(cell: Cell) -> None:
    def read() -> Callable[..., Hold]:
        raise InvalidInputError("No such row.")

    cell.module.act(cell.host.clock.wall_ns, read)
    assert cell.host.drops() == {"malformed": 1}
    assert cell.host.values()["error"] == "No such row."
    assert cell.sent == []


def test_the_publisher_is_no_part_of_what_a_subclass_is_lent(cell: Cell) -> None:
    publisher = cell.host.publishers["joint_trajectory"]
    names = {name for name in dir(cell.module) if not name.startswith("_")}
    lent = {name for name in names if not isinstance(getattr_static(cell.module, name), Moved)}
    assert [name for name in lent if getattr(cell.module, name) is publisher] == []
    limiters = [name for name in lent if hasattr(getattr(cell.module, name), "limit")]
    assert limiters == [], "its setpoint and its rules are not for others to change"


def test_wider_limits_are_refused(cell: Cell) -> None:
    wider = cell.module.config.limits.model_copy(update={"velocity_fraction": 0.9})
    with pytest.raises(Exception, match="velocity_fraction"):
        cell.module.use_limits(wider)
    cell.module.ask([0.9, -0.5])
    assert all(abs(a - START[0]) <= FASTEST * STEP_S + 1e-9 for a, _ in cell.sent)


@pytest.mark.parametrize(
    ("kind", "topic"), [(JointTrajectory, "joint_trajectory"), (JointState, "joint_command")]
)
def test_a_second_path_to_the_joints_is_refused(kind: type, topic: str) -> None:
    """With a stand-in for a node that already commands the arm."""
    made: list[str] = []
    node: Any = SimpleNamespace(
        outputs={"joint_trajectory": lambda: 1},
        create_lifecycle_publisher=lambda *names: made.append(names[1]),
    )
    with pytest.raises(UnsafeError, match="second path to the joints"):
        ModuleHost.advertise(node, kind, topic)
    assert made == []
