"""The control module on a clock of the test: which action moves the arm, for how long, and when the
arm is held.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    Action,
    CollisionProfile,
    Hold,
    JointCommand,
    JointSample,
    RobotProfile,
)
from roboneuron.errors import ConfigurationError, InvalidInputError, UnsafeError
from roboneuron.modules import control as control_module
from roboneuron.modules.control import ControlModule
from roboneuron.ros.messages import to_action_message, to_joint_state, to_joint_trajectory

SILENT = "the server gave no sign of life"
ARM = ("a", "b")
START = np.array([0.5, -0.5])
MakeHost = Callable[..., Any]
TIMEOUT_S, STATE_TIMEOUT_S, SERVER_TIMEOUT_S = 0.3, 0.25, 2.0


class Cell:
    """An active control whose arm stands at START, and what it was told and has sent."""

    def __init__(self, make_host: MakeHost, *, activate: bool = True, **options: Any) -> None:
        self.host = make_host("control", **options)
        self.clock = self.host.clock
        self.control = ControlModule(self.host)
        self.asked: list[tuple[Action, JointSample, float]] = []
        self.takes_s = 0.0
        self.answer: JointCommand | Hold | None = None
        self._compute = self.control._controller.compute
        self.control._controller.compute = self.compute  # type: ignore[method-assign]
        self.position = START.copy()
        if activate:
            self.control.activate()
            self.measure()

    def compute(self, action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        self.asked.append((action, joints, step_s))
        self.clock.go(self.takes_s)
        return self.answer or self._compute(action, joints, step_s)

    def measure(self, **changes: Any) -> None:
        """A joint state arrives."""
        values: dict[str, Any] = {
            "names": ARM,
            "position": self.position.copy(),
            "stamp_ns": self.clock.wall_ns,
        }
        message = to_joint_state(JointSample(**(values | changes)))
        self.host.subscribed[JointState, "joint_states"](message)

    def act(self, metres: float = 0.01, *, age_s: float = 0.0, sent_ns: int | None = None) -> None:
        """An action arrives."""
        self.receive(to_action_message(np.array([metres, 0, 0, 0, 0, 0, 1.0])), age_s, sent_ns)

    def receive(
        self, message: Float64MultiArray, age_s: float = 0.0, sent_ns: int | None = None
    ) -> None:
        source_ns = self.clock.wall_ns - round(age_s * 1e9) if sent_ns is None else sent_ns
        on_action = self.host.subscribed[Float64MultiArray, "action"]
        on_action(message, {"source_timestamp": source_ns})

    def go(self, seconds: float, *, measured: bool = True) -> None:
        """Time passes; the arm is measured at its end."""
        self.clock.go(seconds)
        if measured:
            self.measure()

    def watch(self) -> None:
        self.host.repeated[0][1]()

    @property
    def commands(self) -> list[list[float]]:
        return [list(one.points[0].positions) for one in self.messages]

    @property
    def messages(self) -> list[Any]:
        return self.host.publishers["joint_trajectory"].messages  # type: ignore[no-any-return]

    @property
    def poses(self) -> list[PoseStamped]:
        return self.host.publishers["ee_pose"].messages  # type: ignore[no-any-return]

    @property
    def code(self) -> str:
        return str(self.host.values().get("hold_code", ""))

    def drops(self) -> dict[str, int]:
        """What was dropped, but holds."""
        return {k: v for k, v in self.host.drops().items() if k != "holds"}


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


def duration_s(message: JointTrajectory) -> float:
    time_s = message.points[0].time_from_start
    return time_s.sec + time_s.nanosec / 1e9  # type: ignore[no-any-return]


# How it is made


def test_control_without_its_section_is_refused(make_host: MakeHost) -> None:
    section = '[control]\ncontroller = "adder"\naction_timeout_s = 0.3\n'
    with pytest.raises(ConfigurationError, match=r"no \[control\] section"):
        ControlModule(make_host("control", replace={section: ""}))


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('"adder"', '"subtractor"', "subtractor"),
        ('name = "pair"', 'name = "triple"', "triple"),
        ('name = "pair"', 'name = "pair"\ndriver = "none"', "none"),
    ],
)
def test_parts_that_do_not_fit_are_refused(
    make_host: MakeHost, old: str, new: str, match: str
) -> None:
    with pytest.raises(ConfigurationError, match=match):
        ControlModule(make_host("control", replace={old: new}))


def test_a_driver_that_needs_other_modules_runs_elsewhere(make_host: MakeHost) -> None:
    host = make_host("control", replace={'name = "pair"': 'name = "pair"\ndriver = "elsewhere"'})
    assert ControlModule(host)._profile.name == "pair"


def test_it_listens_and_publishes_under_the_names_of_the_contract(cell: Cell) -> None:
    assert set(cell.host.subscribed) == {
        (JointState, "joint_states"),
        (Float64MultiArray, "action"),
    }
    kinds = {topic: one.message_type for topic, one in cell.host.publishers.items()}
    assert kinds == {"ee_pose": PoseStamped, "joint_trajectory": JointTrajectory}
    assert cell.host.values()["controller"] == "adder"


def test_it_looks_five_times_within_its_timeout(cell: Cell) -> None:
    assert [period_s for period_s, _ in cell.host.repeated] == [pytest.approx(0.06)]


def test_commands_may_be_joint_states(make_host: MakeHost) -> None:
    cell = Cell(
        make_host, replace={'controller = "adder"': 'controller = "adder"\ncommand = "joint_state"'}
    )
    assert cell.control._guard._limiter._immediate
    cell.act(0.001)
    publisher = cell.host.publishers["joint_command"]
    assert publisher.message_type is JointState
    (message,) = publisher.messages
    assert list(message.name) == list(ARM)
    assert list(message.position) == pytest.approx([0.501, -0.5])
    assert message.header.stamp.sec == cell.clock.wall_ns // 10**9
    assert "joint_trajectory" not in cell.host.publishers


class Recorder:
    """How the plugin's controller was made, and what became of it."""

    def __init__(self) -> None:
        self.made: list[tuple[object, RobotProfile]] = []
        self.done: list[str] = []


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch, make_host: MakeHost) -> Recorder:
    import loop_plugin

    recorder = Recorder()

    class Adder(loop_plugin.Adder):  # type: ignore[misc]
        def __init__(self, config: object, profile: RobotProfile) -> None:
            recorder.made.append((config, profile))

        def load(self) -> None:
            recorder.done.append("load")

        def close(self) -> None:
            recorder.done.append("close")

    monkeypatch.setattr(loop_plugin, "Adder", Adder)
    return recorder


def test_the_controller_is_loaded_and_closed(make_host: MakeHost, recorder: Recorder) -> None:
    host = make_host("control")
    control = ControlModule(host)
    assert recorder.done == ["load"]
    control._guard._audit._open()
    host.resources.close()
    assert recorder.done == ["load", "close"]
    assert host.parameters == {}
    assert control._guard._audit._descriptor < 0


def test_a_controller_that_cannot_load_is_closed(
    make_host: MakeHost, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    import loop_plugin

    def load(self: object) -> None:
        raise ConfigurationError("no robot description")

    monkeypatch.setattr(loop_plugin.Adder, "load", load)
    host = make_host("control")
    with pytest.raises(ConfigurationError, match="no robot description"):
        ControlModule(host)
    host.resources.close()
    assert recorder.done == ["close"]


def test_a_controller_without_options_refuses_those_it_is_given(make_host: MakeHost) -> None:
    with pytest.raises(ConfigurationError, match="adder"):
        ControlModule(make_host("control", extra="[plugins.adder]\ngain = 3\n"))


@pytest.mark.parametrize("is_checked", [True, False])
def test_the_controller_looks_for_collisions_as_configured(
    make_host: MakeHost,
    recorder: Recorder,
    monkeypatch: pytest.MonkeyPatch,
    is_checked: bool,
) -> None:
    import loop_plugin

    profile = replace(loop_plugin.profile(), collision=CollisionProfile())
    monkeypatch.setattr(loop_plugin, "profile", lambda: profile)
    ControlModule(make_host("control", extra=f"[limits]\ncollision = {str(is_checked).lower()}\n"))
    ((config, given),) = recorder.made
    assert config is None
    assert given.name == "pair"
    assert (given.collision is not None) == is_checked


def test_a_command_never_outlasts_the_silence_of_a_server(make_host: MakeHost) -> None:
    cell = Cell(make_host, replace={'name = "pair"': 'name = "pair"\nserver_timeout_s = 0.4'})
    cell.answer = JointCommand(names=ARM, position=START, duration_s=0.5)
    cell.act()
    assert cell.code == "long_command"


# Limits


def test_limits_of_the_configuration_hold(make_host: MakeHost) -> None:
    cell = Cell(make_host, extra="[limits]\nvelocity_fraction = 0.05\n")
    assert cell.host.values()["limits"] == "configured"
    cell.act(0.09)
    assert 0.5 < cell.commands[0][0] <= 0.5 + 0.05 * 0.1 + 1e-9


def test_tightened_limits_hold_from_the_start(make_host: MakeHost) -> None:
    cell = Cell(make_host, tightened=LimitsConfig(velocity_fraction=0.05))
    assert cell.host.values()["limits"] == "tightened"
    cell.act(0.09)
    assert 0.5 < cell.commands[0][0] <= 0.5 + 0.05 * 0.1 + 1e-9


def test_tightened_limits_may_not_be_wider(make_host: MakeHost) -> None:
    with pytest.raises(ConfigurationError, match="wider"):
        Cell(
            make_host,
            extra="[limits]\nvelocity_fraction = 0.05\n",
            tightened=LimitsConfig(velocity_fraction=0.5),
        )


def test_limits_are_tightened_and_set_back_while_the_arm_moves(cell: Cell) -> None:
    first, take, refuse = cell.host.parameters["limits"]
    assert first == ""
    text = LimitsConfig(velocity_fraction=0.05).model_dump_json()
    assert refuse(text) == ""
    take(text)
    assert cell.host.values()["limits"] == "tightened"
    cell.act(0.09)
    moved = cell.commands[0][0] - 0.5
    assert 0.0 < moved <= 0.05 * 0.1 + 1e-9
    assert refuse("") == ""
    take("")
    assert cell.host.values()["limits"] == "configured"
    cell.go(0.1)
    cell.act(0.09)
    assert cell.commands[1][0] - 0.5 > 2 * moved


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{", "no valid [limits]"),
        ('{"velocity_fraction": 0.6}', "wider"),
        (
            '{"velocity_fraction": 0.1, "zones": [{"name": "vase", "lower_m": [1, 0, 0],'
            ' "upper_m": [0, 1, 1]}]}',
            "vase",
        ),
    ],
)
def test_limits_that_are_damaged_wider_or_unfit_are_refused(
    make_host: MakeHost, text: str, match: str
) -> None:
    cell = Cell(make_host, extra="[limits]\nvelocity_fraction = 0.5\n")
    _, take, refuse = cell.host.parameters["limits"]
    assert match in refuse(text)
    with pytest.raises(ConfigurationError):
        take(text)
    assert cell.host.values()["limits"] == "configured"


# Joint states


def test_it_is_ready_once_the_arm_was_measured(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)
    cell.control.activate()
    values = cell.host.values()
    assert values["ready"] == "false"
    assert values["waiting_for"] == "joint states on joint_states (is the robot running?)"
    cell.measure()
    assert cell.host.values()["ready"] == "true"


def test_an_inactive_control_publishes_nothing(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)
    cell.measure()
    assert cell.poses == []
    cell.act()
    assert cell.asked == []
    assert cell.host.values()["ready"] == "false"


def test_the_pose_is_published_fifty_times_a_second(cell: Cell) -> None:
    assert len(cell.poses) == 1
    for _ in range(3):
        cell.go(0.009)
    assert len(cell.poses) == 2, "after 27 ms"


def test_a_pose_is_due_exactly_one_period_after_the_one_before(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control_module, "_POSE_PERIOD_S", 0.03125)
    cell.go(0.03125)
    assert len(cell.poses) == 2


def test_a_pose_is_in_the_base_frame_and_noted_as_sent(cell: Cell) -> None:
    assert cell.poses[0].header.frame_id == "base"
    assert cell.host.handover.sent == ["pose"]


def test_a_repeated_state_is_passed_over(cell: Cell) -> None:
    stamp_ns = cell.clock.wall_ns
    cell.clock.go(0.03)
    cell.measure(stamp_ns=stamp_ns)
    assert len(cell.poses) == 1


def test_a_bad_state_is_counted_and_told_until_a_good_one_comes(cell: Cell) -> None:
    cell.go(0.03, measured=False)
    cell.measure(position=np.array([np.nan, 0.0]))
    assert cell.drops() == {"bad_joint_state": 1}
    assert "non-finite" in cell.host.values()["error"]
    cell.go(0.03)
    assert "non-finite" not in cell.host.values().get("error", "")
    assert cell.drops() == {"bad_joint_state": 1}


def test_a_controller_that_knows_no_pose_is_told_and_not_ready(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)

    def forward(joints: JointSample) -> None:
        raise UnsafeError("outside of the joints' travel")

    cell.control._controller.forward = forward  # type: ignore[method-assign, assignment]
    cell.control.activate()
    cell.measure()
    assert cell.host.values()["ready"] == "false"
    assert cell.poses == []
    assert cell.drops() == {"bad_joint_state": 1}


# Actions


def test_an_action_moves_the_arm_by_one_command(cell: Cell) -> None:
    cell.host.status.changed.clear()
    cell.act(0.01, age_s=0.05)
    assert cell.commands == [pytest.approx([0.51, -0.5])]
    action, joints, _ = cell.asked[0]
    assert action.translation_m[0] == 0.01
    assert joints.position.tolist() == [0.5, -0.5]
    values = cell.host.values()
    assert values["note"] == "following actions"
    assert cell.host.handover.sent == ["pose", "command"]
    assert cell.host.status.output.total == 1
    assert cell.host.status.latency.median_and_p99() == pytest.approx((50.0, 50.0))
    assert cell.host.status.changed.is_set()
    assert cell.drops() == {}


def test_what_the_controller_reports_is_told(cell: Cell) -> None:
    cell.answer = JointCommand(
        names=ARM,
        position=np.array([0.501, -0.5]),
        duration_s=0.1,
        residual_m=0.003,
        residual_rad=0.04,
    )
    cell.takes_s = 0.012
    cell.act()
    values = cell.host.values()
    assert (values["residual_m"], values["residual_rad"]) == ("0.003", "0.04")
    assert values["compute_ms"] == "12"


def test_the_first_action_has_a_tenth_of_a_second(cell: Cell) -> None:
    cell.act()
    assert cell.asked[0][2] == 0.1
    assert duration_s(cell.messages[0]) == pytest.approx(0.1)


def test_soon_after_the_machine_was_started_a_first_action_is_a_first_action(
    make_host: MakeHost,
) -> None:
    cell = Cell(make_host, activate=False)
    cell.clock.now_s = 0.5
    cell.control.activate()
    cell.measure()
    assert len(cell.poses) == 1
    cell.act()
    assert cell.asked[0][2] == 0.1


def test_a_later_action_has_the_time_since_the_one_before(cell: Cell) -> None:
    cell.act()
    cell.go(0.07)
    cell.act()
    cell.go(0.2)
    cell.act()
    assert [step_s for _, _, step_s in cell.asked[1:]] == pytest.approx([0.07, 0.2])


def test_no_action_has_less_than_the_shortest_step(cell: Cell) -> None:
    cell.act()
    cell.go(0.005)
    cell.act()
    assert cell.asked[1][2] == 0.02


def test_an_action_after_a_pause_has_the_time_of_a_first_one(cell: Cell) -> None:
    cell.act()
    cell.go(TIMEOUT_S + 1e-6)
    cell.act()
    cell.go(TIMEOUT_S - 0.001)
    cell.act()
    assert [step_s for _, _, step_s in cell.asked[1:]] == pytest.approx([0.1, TIMEOUT_S - 0.001])


def test_a_pause_of_exactly_the_timeout_is_a_pause(make_host: MakeHost) -> None:
    """0.25 s are exact in binary."""
    cell = Cell(make_host, replace={"action_timeout_s = 0.3": "action_timeout_s = 0.25"})
    cell.act()
    cell.go(0.25)
    cell.act()
    assert cell.asked[1][2] == 0.1


def test_actions_that_were_held_up_have_the_time_between_their_sendings(cell: Cell) -> None:
    """They arrive together, and were not meant to follow each other at once."""
    sent_ns = cell.clock.wall_ns - 120_000_000
    cell.act(sent_ns=sent_ns)
    cell.go(0.001)
    cell.act(sent_ns=sent_ns + 60_000_000)
    cell.go(0.001)
    cell.act(sent_ns=sent_ns + 121_000_000)
    assert [step_s for _, _, step_s in cell.asked[1:]] == pytest.approx([0.06, 0.061])


def test_the_time_between_sendings_is_exact(cell: Cell) -> None:
    sent_ns = cell.clock.wall_ns - 120_000_000
    cell.act(sent_ns=sent_ns)
    cell.act(sent_ns=sent_ns + 62_500_000)
    assert cell.asked[1][2] == 0.0625


def test_the_time_between_sendings_counts_as_a_first_step_at_most(cell: Cell) -> None:
    sent_ns = cell.clock.wall_ns - 250_000_000
    cell.act(sent_ns=sent_ns)
    cell.go(0.001)
    cell.act(sent_ns=sent_ns + 240_000_000)
    assert cell.asked[1][2] == pytest.approx(0.1)


def test_an_action_may_be_as_old_as_the_timeout(cell: Cell) -> None:
    cell.act(age_s=TIMEOUT_S - 1e-6)
    assert len(cell.commands) == 1
    cell.act(age_s=TIMEOUT_S + 1e-6)
    assert (len(cell.commands), cell.drops()) == (1, {"stale_action": 1})


def test_an_action_exactly_at_the_timeout_counts(make_host: MakeHost) -> None:
    cell = Cell(make_host, replace={"action_timeout_s = 0.3": "action_timeout_s = 0.25"})
    cell.act(age_s=0.25)
    assert len(cell.commands) == 1


def test_an_action_that_is_a_nanosecond_too_old_is_stale(make_host: MakeHost) -> None:
    cell = Cell(make_host, replace={"action_timeout_s = 0.3": "action_timeout_s = 2.0"})
    cell.act(sent_ns=cell.clock.wall_ns - 2_000_000_001)
    assert cell.drops() == {"stale_action": 1}


def test_an_action_may_come_from_a_clock_that_is_a_little_ahead(cell: Cell) -> None:
    cell.act(age_s=-0.1)
    assert len(cell.commands) == 1
    cell.act(age_s=-0.1 - 1e-6)
    assert (len(cell.commands), cell.drops()) == (1, {"future_action": 1})


def test_an_older_action_after_a_newer_one_is_dropped(cell: Cell) -> None:
    sent_ns = cell.clock.wall_ns
    cell.act(sent_ns=sent_ns)
    cell.go(0.05)
    cell.act(sent_ns=sent_ns - 1)
    assert (len(cell.commands), cell.drops()) == (1, {"reordered_action": 1})
    cell.act(sent_ns=sent_ns)
    assert len(cell.commands) == 2


def test_after_the_clock_was_set_back_newer_actions_count(cell: Cell) -> None:
    now_ns = cell.clock.wall_ns
    cell.control._action_ns = now_ns + 100_000_000
    cell.act()
    assert cell.drops() == {"reordered_action": 1}, "a clock may be a little ahead"
    cell.control._action_ns = now_ns + 100_001_000
    cell.act()
    assert len(cell.commands) == 1


def test_the_time_of_an_answered_action_counts_for_reordering_though_it_was_held(
    cell: Cell,
) -> None:
    sent_ns = cell.clock.wall_ns
    cell.answer = Hold(code="too_far", reason="a metre")
    cell.act(sent_ns=sent_ns)
    cell.answer = None
    cell.act(sent_ns=sent_ns - 1)
    assert cell.drops() == {"too_far": 1, "reordered_action": 1}


@pytest.mark.parametrize("size", [0, 6, 8])
def test_an_action_of_another_size_is_malformed(cell: Cell, size: int) -> None:
    message = to_action_message(np.zeros(7))
    message.data = message.data[:0].__class__("d", [0.0] * size)
    cell.receive(message)
    assert (cell.commands, cell.drops()) == ([], {"malformed": 1})
    assert cell.host.values()["error"]


def test_an_action_that_is_not_finite_is_told_apart(cell: Cell) -> None:
    cell.receive(to_action_message(np.array([np.nan, 0, 0, 0, 0, 0, 1.0])))
    assert (cell.commands, cell.drops()) == ([], {"non_finite": 1})
    assert cell.host.values()["error"]
    assert cell.asked == []


STOPS: dict[str, Callable[[Cell], None]] = {
    "emergency_stop": lambda cell: setattr(cell.host, "stopped", True),
    "server_silent": lambda cell: setattr(cell.host, "silence_s", SERVER_TIMEOUT_S + 1e-6),
    "needs_new_start": lambda cell: setattr(cell.host, "needs_start", "a stop"),
    "stale_joint_state": lambda cell: cell.go(STATE_TIMEOUT_S + 1e-6, measured=False),
}


@pytest.mark.parametrize("word", STOPS)
def test_nothing_is_commanded_after_a_stop(cell: Cell, word: str) -> None:
    STOPS[word](cell)
    cell.act()
    assert (cell.commands, cell.asked, cell.drops()) == ([], [], {word: 1})


def test_bounds_that_are_reached_and_not_passed_stop_nothing(cell: Cell) -> None:
    cell.host.silence_s = SERVER_TIMEOUT_S
    cell.go(STATE_TIMEOUT_S, measured=False)
    cell.act()
    assert len(cell.commands) == 1


@pytest.mark.parametrize("word", [*STOPS, "stale_action"])
def test_a_stop_while_the_controller_computes_is_the_last_word(cell: Cell, word: str) -> None:
    cell.act()
    before = cell.commands
    cell.go(0.1)

    def compute(action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        if word == "stale_action":
            cell.clock.go(0.22)
        else:
            STOPS[word](cell)
        return JointCommand(names=ARM, position=START + 0.01, duration_s=0.1)

    cell.control._controller.compute = compute  # type: ignore[method-assign]
    cell.act(age_s=0.09 if word == "stale_action" else 0.0)
    assert cell.code == word
    assert cell.drops() == {word: 1}
    expected = [] if word == "stale_joint_state" else [pytest.approx([0.5, -0.5])]
    assert cell.commands == [*before, *expected], "the arm is held where it is measured"
    if word == "stale_action":
        assert cell.host.values()["note"].startswith(
            "holding: A command was ready only 0.22 s after its action"
        )


def test_a_command_that_came_too_late_is_no_setpoint(cell: Cell) -> None:
    cell.takes_s = 0.26
    cell.act(0.01)
    cell.takes_s = 0.0
    assert cell.control._guard._limiter._sent is None, "its joints are not known any more"


def test_a_controller_that_takes_its_time_is_in_time(cell: Cell) -> None:
    cell.takes_s = 0.1
    cell.act(age_s=0.19)
    assert len(cell.commands) == 1
    assert cell.drops() == {}


def test_a_hold_of_the_controller_holds_the_arm(cell: Cell) -> None:
    cell.act()
    cell.position = np.array([0.505, -0.5])
    cell.go(0.05)
    cell.act(0.5)
    assert cell.commands[1:] == [pytest.approx([0.505, -0.5])]
    assert cell.code == "too_far"
    assert cell.drops() == {"too_far": 1}
    assert cell.host.values()["note"] == "holding: 0.5 m is more than 0.1 m."


def test_a_refused_action_leaves_the_one_before(make_host: MakeHost) -> None:
    """It comes to its end, and is then held by the watchdog."""
    cell = Cell(make_host, extra='[limits]\nvelocity_fraction = 0.5\non_velocity = "refuse"\n')
    cell.act(0.01)
    acted_s = cell.control._action_s
    cell.go(0.1)
    cell.act(0.09)
    assert len(cell.commands) == 1
    assert cell.control._action_s == acted_s
    assert cell.drops() == {"limit_velocity": 1}
    cell.go(0.13)
    cell.watch()
    assert cell.code == "no_action"


def test_a_command_of_a_posture_is_judged_by_the_limits(cell: Cell) -> None:
    cell.act(0.01)
    assert cell.host.values()["sent_share"] == "1"
    cell.answer = JointCommand(names=ARM, position=np.array([np.nan, 0.0]), duration_s=0.1)
    cell.go(0.05)
    cell.act()
    assert cell.code == "unsafe_command"


# In the shadow of another control


def test_in_shadow_everything_is_worked_out_and_nothing_sent(make_host: MakeHost) -> None:
    cell = Cell(make_host, shadow=True)
    cell.act()
    for _ in range(2):
        cell.go(0.001)
    withheld = [type(one).__name__ for one in cell.host.handover.withheld]
    assert withheld == ["Pose", "JointCommand", "Pose", "Pose"], "every state is answered"
    assert (cell.commands, cell.poses, cell.host.handover.sent) == ([], [], [])
    assert cell.host.values()["ready"] == "true"
    cell.control.emergency_stop(True)
    assert cell.commands == []
    assert cell.code == ""


def test_what_is_the_successors_is_left_to_it(cell: Cell) -> None:
    cell.act()
    cell.host.handover.set("act_until_ns", cell.clock.wall_ns + 1)
    cell.go(0.03)
    cell.act()
    assert len(cell.asked) == 1
    assert len(cell.poses) == 1
    assert cell.drops() == {}
    cell.go(1.0)
    cell.watch()
    cell.control.deactivate()
    assert len(cell.commands) == 1
    assert cell.code == ""


def test_a_successor_goes_on_from_the_predecessors_command(cell: Cell) -> None:
    command = JointCommand(names=ARM, position=np.array([0.52, -0.5]), duration_s=0.1)
    sent_s = cell.clock.now_s - 0.05
    taken = cell.control.follow(to_joint_trajectory(command), sent_s)
    assert taken.position.tolist() == [0.52, -0.5]
    sent = cell.control._guard._limiter._sent
    assert sent is not None
    assert sent.sent_s == sent_s
    assert sent.way == pytest.approx([0.02, 0.0])
    cell.watch()
    assert cell.commands == []
    cell.go(0.18)
    cell.watch()
    assert cell.code == "no_action", "counted from the predecessor's command"


def test_a_predecessors_command_is_read_and_changes_nothing_after_the_first_of_ones_own(
    cell: Cell,
) -> None:
    cell.act()
    sent, acted_s = cell.control._guard._limiter._sent, cell.control._action_s
    command = JointCommand(names=ARM, position=np.array([0.6, -0.5]), duration_s=0.1)
    assert cell.control.follow(to_joint_trajectory(command), 1.0).position[0] == 0.6
    assert cell.control._guard._limiter._sent is sent
    assert cell.control._action_s == acted_s


def test_a_predecessors_command_before_the_arm_was_measured_is_only_read(
    make_host: MakeHost,
) -> None:
    cell = Cell(make_host, activate=False)
    command = JointCommand(names=ARM, position=np.array([0.6, -0.5]), duration_s=0.1)
    assert cell.control.follow(to_joint_trajectory(command), 1.0).position[0] == 0.6
    assert cell.control._guard._limiter._sent is None
    assert cell.control._holding


def test_a_malformed_command_of_the_predecessor_is_refused(cell: Cell) -> None:
    with pytest.raises(InvalidInputError):
        cell.control.follow(JointTrajectory(), 1.0)


# When it holds


def test_it_holds_after_three_quarters_of_its_timeout(cell: Cell) -> None:
    cell.act()
    cell.position = np.array([0.507, -0.5])
    cell.go(TIMEOUT_S * 0.75 - 1e-6)
    cell.watch()
    assert len(cell.commands) == 1
    cell.go(2e-6)
    cell.host.status.changed.clear()
    cell.watch()
    assert cell.commands[1:] == [pytest.approx([0.507, -0.5])]
    assert duration_s(cell.messages[1]) == pytest.approx(0.05)
    assert list(cell.messages[1].joint_names) == list(ARM)
    assert cell.host.drops() == {"holds": 1}
    assert cell.code == "no_action"
    assert cell.host.values()["note"] == "holding: No action for 0.3 s."
    assert cell.host.status.changed.is_set()
    cell.go(1.0)
    cell.watch()
    assert len(cell.commands) == 2, "it holds once"
    assert cell.host.drops() == {"holds": 1}


def test_it_holds_after_that_share_and_not_at_its_end(make_host: MakeHost) -> None:
    """0.1875 s are exact in binary."""
    cell = Cell(make_host, replace={"action_timeout_s = 0.3": "action_timeout_s = 0.25"})
    cell.act()
    cell.go(0.1875)
    cell.watch()
    assert cell.code == ""


def test_after_a_hold_the_next_command_begins_at_rest_where_the_arm_is(cell: Cell) -> None:
    cell.act()
    cell.position = np.array([0.507, -0.5])
    cell.go(0.3)
    cell.watch()
    sent = cell.control._guard._limiter._sent
    assert sent is not None
    assert sent.start.tolist() == [0.507, -0.5]
    assert sent.way.tolist() == [0.0, 0.0]
    assert sent.sent_s == cell.clock.now_s


def test_it_moves_again_after_a_hold_and_holds_again(cell: Cell) -> None:
    for count in (1, 2):
        cell.act()
        cell.go(0.3)
        cell.watch()
        assert cell.host.drops()["holds"] == count


def test_it_holds_when_joint_states_cease_as_soon_as_one_comes(cell: Cell) -> None:
    """Not where it was: the arm would go back."""
    cell.go(STATE_TIMEOUT_S - 0.01, measured=False)
    cell.act()
    cell.go(0.02, measured=False)
    cell.watch()
    assert cell.code == "stale_joint_state"
    assert cell.host.values()["note"] == "holding: No joint state for 0.25 s."
    assert len(cell.commands) == 1
    cell.position = np.array([0.51, -0.5])
    cell.measure()
    assert cell.commands[1:] == [pytest.approx([0.51, -0.5])]
    cell.go(0.03)
    assert len(cell.commands) == 2, "it is held once"


def test_a_hold_that_is_due_is_forgotten_by_a_newer_action(cell: Cell) -> None:
    cell.control._hold_is_due = True
    cell.act()
    cell.go(0.03)
    assert len(cell.commands) == 1


def test_it_holds_when_the_server_falls_silent_and_needs_a_new_start(cell: Cell) -> None:
    cell.act()
    cell.host.silence_s = SERVER_TIMEOUT_S
    cell.watch()
    assert len(cell.commands) == 1
    cell.host.silence_s = SERVER_TIMEOUT_S + 0.01
    cell.watch()
    assert cell.code == "server_silent"
    assert cell.host.needs_start == SILENT
    assert cell.host.values()["note"] == "holding: No sign of life of the server for 2 s."
    assert len(cell.commands) == 2


def test_a_stop_that_is_known_is_not_reported_as_another(cell: Cell) -> None:
    cell.act()
    cell.host.needs_start = "the emergency stop"
    cell.host.silence_s = 9.0
    cell.watch()
    assert cell.host.needs_start == "the emergency stop"
    assert cell.code == "server_silent"


def test_nothing_is_watched_before_the_first_action(cell: Cell) -> None:
    cell.host.silence_s = 9.0
    cell.go(5.0, measured=False)
    cell.watch()
    assert cell.code == ""
    assert cell.commands == []


def test_an_inactive_control_watches_nothing(cell: Cell) -> None:
    cell.act()
    cell.control._active = False
    cell.go(5.0)
    cell.watch()
    assert len(cell.commands) == 1


def test_deactivating_holds_and_ends_all_commands(cell: Cell) -> None:
    cell.act()
    cell.control.deactivate()
    assert len(cell.commands) == 2
    assert cell.code == "deactivated"
    assert cell.host.values()["note"] == "holding: Control was deactivated."
    cell.go(0.03)
    cell.act()
    cell.control.deactivate()
    assert len(cell.commands) == 2
    assert len(cell.poses) == 1


def test_a_control_that_was_never_active_holds_nothing(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)
    cell.control.deactivate()
    cell.control.emergency_stop(True)
    cell.control.forget()
    assert cell.code == ""
    assert cell.commands == []


def test_activating_again_begins_at_a_hold(cell: Cell) -> None:
    cell.act()
    cell.control._hold_is_due = True
    cell.control.activate()
    cell.go(0.5)
    cell.watch()
    assert len(cell.commands) == 1, "nothing leads back to what was before"


def test_an_emergency_stop_holds_at_once_and_its_release_moves_nothing(cell: Cell) -> None:
    cell.act()
    cell.control.emergency_stop(False)
    assert len(cell.commands) == 1
    cell.control.emergency_stop(True)
    assert len(cell.commands) == 2
    assert cell.code == "emergency_stop"
    assert cell.host.values()["note"] == "holding: The emergency stop is latched."


def test_what_was_asked_for_before_a_stop_is_forgotten(cell: Cell) -> None:
    cell.act()
    cell.host.needs_start = "the emergency stop"
    cell.control.forget()
    assert len(cell.commands) == 2
    assert cell.code == "needs_new_start"
    assert (
        "Motion needs a new start after a stop: the emergency stop." in cell.host.values()["note"]
    )


def test_a_further_reason_to_hold_is_told_and_moves_nothing(cell: Cell) -> None:
    cell.act()
    cell.control.deactivate()
    cell.control.activate()
    cell.control.emergency_stop(True)
    assert cell.code == "emergency_stop"
    assert len(cell.commands) == 2
    assert cell.host.drops() == {"holds": 1}


def test_a_hold_names_the_joints_of_the_arm_only(cell: Cell) -> None:
    cell.act()
    cell.go(0.05, measured=False)
    cell.measure(names=("finger", "b", "a"), position=np.array([0.04, -0.5, 0.51]))
    cell.control.emergency_stop(True)
    assert cell.commands[1] == pytest.approx([0.51, -0.5])
    assert list(cell.messages[1].joint_names) == list(ARM)


def test_the_clock_of_the_test_is_the_modules_clock(cell: Cell) -> None:
    assert cell.control._pose_s == cell.clock.now_s != time.monotonic()
