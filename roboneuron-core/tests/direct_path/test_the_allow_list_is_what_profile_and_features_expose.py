"""What agents may use: the endpoints of the profile, or those of features, checked together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rn_testing.fakes import FAKE_CONTROLLER, fake_registry, gantry_profile
from roboneuron.config import LimitsConfig, parse_config
from roboneuron.contract import Endpoint, JointSample
from roboneuron.direct_path import allow_list as allow_list_module
from roboneuron.direct_path.allow_list import AllowList
from roboneuron.direct_path.exposed import ACTION_LABEL, LEAD_LABEL
from roboneuron.direct_path.gate import Gate
from roboneuron.errors import ConfigurationError, RefusedError
from roboneuron.estop import EmergencyStopLatch
from roboneuron.feature import ExposedEndpoint, GateRequest
from roboneuron.gate import AuditLog
from roboneuron.gate.motion.path_limits import Leg, LimitError

PROFILE = gantry_profile()
CONTROLLED = '[robot]\nname = "gantry"\n[control]\ncontroller = "gantry"\n'
DRIVE = Endpoint(
    name="drive",
    kind="publish",
    topic="cmd_vel",
    type="geometry_msgs/msg/Twist",
    summary="drive",
    bounds={"linear.x": (-0.5, 0.5)},
    rate_hz=5.0,
)
MOVE = Endpoint(
    name="move",
    kind="publish",
    topic="joint_command",
    type="sensor_msgs/msg/JointState",
    summary="move",
    joint_limited=True,
)


def exposed(endpoint: Endpoint, robot: str = "gantry", **changes: Any) -> ExposedEndpoint:
    return ExposedEndpoint(
        **(
            {"robot": robot, "namespace": robot, "label": endpoint.name, "endpoint": endpoint}
            | changes
        )
    )


class Cell:
    """An allow list in front of a gate, with the configuration and the plugins of now."""

    def __init__(self, gate: Gate, text: str = CONTROLLED) -> None:
        self.gate = gate
        self.config = parse_config(text)
        self.registry = fake_registry()
        self.limits = LimitsConfig()
        self.told = 0
        self.list = AllowList(
            gate, lambda: self.config, lambda: self.registry, lambda: self.limits, self.note
        )

    def note(self) -> None:
        self.told += 1

    @property
    def names(self) -> list[str]:
        return [one.endpoint.name for one in self.list.exposed]

    @property
    def allowed(self) -> list[tuple[str, str]]:
        return [(entry.robot, entry.endpoint.name) for entry in self.gate.allowed()]


@pytest.fixture
def gate(latch: EmergencyStopLatch, audit: AuditLog, clock: Any) -> Gate:
    """A gate that allows nothing yet."""
    return Gate((), latch=latch, audit=audit, clock=clock.monotonic)


@pytest.fixture
def cell(gate: Gate) -> Cell:
    return Cell(gate)


# Profile and features


def test_nothing_is_exposed_before_somebody_asks_for_it(cell: Cell) -> None:
    assert (cell.list.exposed, cell.allowed, cell.told) == ((), [], 0)


def test_the_profile_of_the_present_robot_is_exposed_with_the_actions_of_its_arm(
    cell: Cell,
) -> None:
    cell.list.refresh()
    assert cell.names == ["joint_states", ACTION_LABEL, LEAD_LABEL]
    assert cell.allowed == [
        ("gantry", "joint_states"),
        ("gantry", ACTION_LABEL),
        ("gantry", LEAD_LABEL),
    ]
    assert [one.hidden for one in cell.list.exposed] == [False, True, True]
    assert cell.told == 1


def test_a_robot_that_no_plugin_knows_exposes_nothing(gate: Gate) -> None:
    cell = Cell(gate, '[robot]\nname = "rover"\n')
    cell.list.refresh()
    assert (cell.names, cell.told) == ([], 1)


def test_a_feature_exposes_more_or_something_else_instead(cell: Cell) -> None:
    cell.list.expose("ros", [exposed(DRIVE)])
    assert cell.names == ["joint_states", "drive", ACTION_LABEL, LEAD_LABEL]
    cell.list.expose("ros", [exposed(DRIVE)], instead_of_profile=True)
    assert cell.names == ["drive"]
    assert cell.told == 2
    cell.list.refresh()
    assert (cell.names, cell.told) == (["drive"], 3)
    cell.list.expose("ros", [])
    assert cell.names == [], "it still stands instead of the profile"


def test_features_expose_side_by_side_each_its_own(cell: Cell) -> None:
    horn = replace(DRIVE, name="horn", topic="horn")
    cell.list.expose("first", [exposed(DRIVE)])
    cell.list.expose("second", [exposed(horn)])
    assert cell.names == ["joint_states", "drive", "horn", ACTION_LABEL, LEAD_LABEL]
    cell.list.expose("first", [])
    assert cell.names == ["joint_states", "horn", ACTION_LABEL, LEAD_LABEL]


def test_the_actions_of_an_arm_are_those_of_the_present_robot_alone(cell: Cell) -> None:
    other = replace(PROFILE, name="other")
    cell.list.expose("ros", [exposed(DRIVE, "base", profile=other)], instead_of_profile=True)
    assert cell.names == ["drive"]
    cell.list.expose("ros", [exposed(DRIVE, "base", profile=other), exposed(MOVE, profile=PROFILE)])
    assert cell.names == ["drive", "move", ACTION_LABEL, LEAD_LABEL]
    assert cell.list.exposed[-1].robot == "gantry"


# What cannot be exposed


@pytest.mark.parametrize(
    ("endpoint", "changes", "text"),
    [
        (replace(DRIVE, topic="action"), {}, "written by RoboNeuron alone"),
        (replace(DRIVE, name="A b"), {}, "the name must be"),
        (replace(DRIVE, stop_message="zero", kind="read"), {}, "makes no sense"),
        (
            replace(DRIVE, topic="/gantry/cmd_vel"),
            {"robot": "base", "namespace": "base"},
            "is of the robot 'gantry'",
        ),
    ],
)
def test_what_cannot_be_exposed_leaves_the_old_list(
    cell: Cell, endpoint: Endpoint, changes: dict[str, Any], text: str
) -> None:
    cell.list.expose("ros", [exposed(DRIVE)])
    before, allowed = cell.list.exposed, cell.allowed
    bad = replace(exposed(endpoint), **changes)
    with pytest.raises(ConfigurationError, match=text):
        cell.list.expose("another", [bad], instead_of_profile=True)
    assert (cell.list.exposed, cell.allowed, cell.told) == (before, allowed, 1)
    cell.list.refresh()
    assert cell.list.exposed == before or cell.names == [one.endpoint.name for one in before]


def test_two_endpoints_of_a_robot_have_two_names(cell: Cell) -> None:
    same = replace(DRIVE, topic="another")
    with pytest.raises(ConfigurationError, match=r"^Two endpoints of 'gantry' are called 'drive'"):
        cell.list.expose("ros", [exposed(DRIVE), exposed(same)])
    assert cell.names == []
    cell.list.expose("ros", [exposed(DRIVE), exposed(same, "base")])
    assert cell.names.count("drive") == 2


def test_the_namespaces_of_other_robots_that_are_exposed_are_theirs(cell: Cell) -> None:
    """A hidden endpoint makes no robot known."""
    theirs = replace(DRIVE, name="theirs", topic="/base/cmd_vel")
    hidden = exposed(DRIVE, "base", hidden=True)
    cell.list.expose("ros", [hidden, exposed(theirs)])
    with pytest.raises(ConfigurationError, match="is of the robot 'base'"):
        cell.list.expose("ros", [replace(hidden, hidden=False), exposed(theirs)])


# Limits of one topic


def test_two_names_of_one_topic_share_the_limits_of_both(cell: Cell) -> None:
    slow = replace(DRIVE, name="slow", bounds={"linear.x": (-0.1, 0.9)}, rate_hz=2.0)
    cell.list.expose("first", [exposed(DRIVE)])
    cell.list.expose("second", [exposed(slow, moves=False)])
    both = [one for one in cell.list.exposed if one.endpoint.topic == "cmd_vel"]
    assert [one.endpoint.bounds for one in both] == [{"linear.x": (-0.1, 0.5)}] * 2
    assert [one.endpoint.rate_hz for one in both] == [2.0, 2.0]
    assert [one.moves for one in both] == [True, True]


def test_what_one_feature_exposes_instead_of_the_profile_has_been_made_equal_by_it(
    cell: Cell,
) -> None:
    slow = replace(DRIVE, name="slow", bounds={"linear.x": (-0.1, 0.1)})
    listed = [exposed(DRIVE), exposed(slow)]
    cell.list.expose("ros", listed, instead_of_profile=True)
    assert [one.endpoint.bounds["linear.x"][1] for one in cell.list.exposed] == [0.5, 0.1]
    cell.list.expose("another", [])
    assert [one.endpoint.bounds["linear.x"][1] for one in cell.list.exposed] == [0.1, 0.1]


def test_one_feature_beside_the_profile_is_held_to_the_limits_of_the_topic(cell: Cell) -> None:
    slow = replace(DRIVE, name="slow", bounds={"linear.x": (-0.1, 0.1)})
    cell.list.expose("ros", [exposed(DRIVE), exposed(slow)])
    drives = [one for one in cell.list.exposed if one.endpoint.topic == "cmd_vel"]
    assert [one.endpoint.bounds["linear.x"][1] for one in drives] == [0.1, 0.1]


# Limits of an arm


def test_only_joint_motions_of_an_arm_with_a_tcp_are_judged_in_space(cell: Cell) -> None:
    wheels = replace(PROFILE, name="wheels", tcp_link="", arm_joints=())
    cell.list.expose(
        "ros",
        [
            exposed(MOVE, profile=PROFILE),
            exposed(DRIVE, profile=PROFILE),
            exposed(replace(MOVE, name="turn"), "base", profile=wheels),
            exposed(replace(MOVE, name="bend"), "stranger"),
        ],
        instead_of_profile=True,
    )
    judged = {entry.endpoint.name: entry for entry in cell.gate.allowed()}
    assert {name for name, entry in judged.items() if entry.path is not None} == {"move"}
    assert {name for name, entry in judged.items() if entry.rules is not None} == {"move"}
    rules = judged["move"].rules
    assert rules is not None
    assert rules.max_speed_m_s == LimitsConfig().max_speed_m_s
    assert judged["move"].topic == "/gantry/joint_command"


def leg(*position: float, duration_s: float = 1.0) -> Leg:
    return Leg(names=("slide_x",), position=np.array(position), duration_s=duration_s)


AT_ZERO = JointSample(names=PROFILE.arm_joints, position=np.zeros(6))


def test_limits_that_have_changed_hold_for_joint_motions_once_they_are_told(cell: Cell) -> None:
    cell.list.expose("ros", [exposed(MOVE, profile=PROFILE)], instead_of_profile=True)
    (entry, *_) = cell.gate.allowed()
    assert entry.path is not None
    entry.path().check([leg(0.4)], AT_ZERO)
    cell.limits = LimitsConfig(max_speed_m_s=0.1)
    cell.list.relimit()
    (entry, *_) = cell.gate.allowed()
    assert entry.path is not None
    assert entry.rules is not None
    assert entry.rules.max_speed_m_s == 0.1
    with pytest.raises(LimitError, match=r"allowed is 0\.1 m/s"):
        entry.path().check([leg(0.4)], AT_ZERO)
    assert cell.told == 1, "the endpoints are the same"


def test_limits_that_cannot_be_leave_the_old_ones(cell: Cell) -> None:
    cell.list.expose("ros", [exposed(MOVE, profile=PROFILE)], instead_of_profile=True)
    cell.limits = LimitsConfig.model_validate({"workspace_upper_m": [5.0, 5.0, 5.0]})
    with pytest.raises(ConfigurationError):
        cell.list.relimit()
    (entry, *_) = cell.gate.allowed()
    assert entry.rules is not None
    assert entry.rules.upper_m.tolist() == [0.9] * 3


def test_joint_motions_of_an_arm_without_a_controller_are_refused(
    gate: Gate, ask: Callable[..., GateRequest]
) -> None:
    cell = Cell(gate, '[robot]\nname = "gantry"\n')
    cell.registry = fake_registry()
    spare = replace(FAKE_CONTROLLER, name="spare")
    cell.list.expose("ros", [exposed(MOVE, profile=PROFILE)], instead_of_profile=True)
    request = ask(MOVE, {"name": ["slide_x"], "position": [0.1]}, robot="gantry", joints=AT_ZERO)
    assert gate.check(request).may_send, "the only controller there is"
    cell.registry = fake_registry(spare)
    cell.list.relimit()
    with pytest.raises(
        RefusedError, match=r"no controller, installed are gantry, spare\."
    ) as caught:
        gate.check(request)
    assert "[control]" in caught.value.hint


def test_a_profile_is_loaded_for_the_robot_that_is_configured_now(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Any, Any]] = []

    def load(registry: Any, robot: Any) -> Any:
        asked.append((registry, robot))
        return replace(PROFILE, endpoints=(DRIVE,))

    monkeypatch.setattr(allow_list_module, "load_profile", load)
    cell.list.refresh()
    assert asked == [(cell.registry, cell.config.robot)]
    first = cell.list.exposed[0]
    assert (first.robot, first.namespace) == ("gantry", "gantry")
    cell.config = parse_config(CONTROLLED.replace("[control]", 'namespace = "cell_b"\n[control]'))
    cell.list.refresh()
    assert cell.list.exposed[0].namespace == cell.config.namespace == "cell_b"
