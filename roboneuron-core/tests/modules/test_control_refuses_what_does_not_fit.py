"""Control is built from compatible parts, and uses compatible limits; on a test clock."""

from __future__ import annotations

from dataclasses import replace

import pytest
from control_cell import (
    ARM,
    START,
    Cell,
    MakeHost,
)
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    CollisionProfile,
    Hold,
    JointCommand,
    RobotProfile,
)
from roboneuron.errors import ConfigurationError
from roboneuron.gate.motion import LimitedCommand
from roboneuron.modules.control.module import ControlModule
from roboneuron.tools.arm.limit_reports import LimitReports, join


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


def test_control_without_its_section_is_refused(make_host: MakeHost) -> None:
    section = '[control]\ncontroller = "adder"\naction_timeout_s = 0.3\n'
    with pytest.raises(ConfigurationError, match=r"no \[control\] section"):
        ControlModule(make_host("control", replace={section: ""}))


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('"adder"', '"subtractor"', "subtractor"),
        ('"adder"', '"wheels"', "but 'pair' is of kind 'arm'"),
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
    assert ControlModule(host).profile.name == "pair"


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
    assert cell.control._limiter._immediate
    cell.act(0.001)
    publisher = cell.host.publishers["joint_command"]
    assert publisher.message_type is JointState
    (message,) = publisher.messages
    assert list(message.name) == list(ARM)
    assert list(message.position) == pytest.approx([0.501, -0.5])
    assert message.header.stamp.sec == cell.clock.wall_ns // 10**9
    assert "joint_trajectory" not in cell.host.publishers


class Recorder:
    """Records how the plugin's controller was created and used."""

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
    ControlModule(host)
    assert recorder.done == ["load"]
    host.resources.close()
    assert recorder.done == ["load", "close"]
    assert host.parameters == {}


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


@pytest.mark.parametrize(
    ("has_bodies", "tells_distances", "is_checked"),
    [(False, False, "false"), (False, True, "false"), (True, True, "true"), (True, False, "false")],
)
def test_it_is_told_whether_collisions_are_checked(
    make_host: MakeHost,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    has_bodies: bool,
    tells_distances: bool,
    is_checked: str,
) -> None:
    import loop_plugin

    if has_bodies:
        profile = replace(loop_plugin.profile(), collision=CollisionProfile())
        monkeypatch.setattr(loop_plugin, "profile", lambda: profile)
    if tells_distances:
        # a separate class, because the capabilities of a class are cached
        seeing = type("SeeingAdder", (loop_plugin.Adder,), {"inspect": lambda self, joints: None})
        monkeypatch.setattr(loop_plugin, "Adder", seeing)
    host = make_host("control")
    ControlModule(host)
    assert host.values()["collision_checked"] == is_checked
    is_warned = has_bodies and not tells_distances
    assert ("collisions of pair are not checked" in caplog.text) == is_warned


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


def test_a_command_that_the_limits_reject_is_counted_for_the_last_of_them(cell: Cell) -> None:
    rejected = LimitedCommand(command=None, acted=("speed", "zone"), reason="a vase", share=0.0)
    cell.control._limiter.limit = lambda *_: rejected  # type: ignore[method-assign]
    cell.act()
    assert cell.drops() == {"limit_zone": 1}
    assert cell.commands == []


def test_what_the_limits_do_is_recorded_until_cleanup(cell: Cell) -> None:
    (reports,) = (one for one in cell.control.filters if isinstance(one, LimitReports))
    held = Hold(code="limit_zone", reason="a vase")
    reports.note_limited(LimitedCommand(command=held, acted=("zone",), reason="a vase", share=0.0))
    audit = reports._audit
    assert audit._descriptor >= 0
    cell.host.resources.close()
    assert audit._descriptor < 0
    assert cell.host.parameters == {}


def test_only_control_has_limits(make_host: MakeHost) -> None:
    host = make_host("robot")
    join(host)
    assert host.on_configured == []
