"""Latches, audits and leases are per robot; a stop of the whole reaches all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from mcp import types

from rn_standard.fleet.connection import participants_of
from rn_standard.fleet.fleet import Fleet
from rn_standard.fleet.plugin import FEATURE
from rn_standard.http.feature import HttpFeature
from rn_testing.fakes import fake_registry
from roboneuron.config import parse_config
from roboneuron.estop import ESTOP_FILE, EmergencyStopLatch
from roboneuron.server.tool import LOCAL_AGENT

Call = Callable[..., types.CallToolResult]


def latched(fleet: Fleet) -> list[str]:
    return [name for name, robot in fleet.robots.items() if robot.loop.emergency_stop.is_latched()]


def test_a_stop_of_one_robot_leaves_the_others(fleet: Fleet, tmp_path: Path) -> None:
    fleet.robots["left"].loop.emergency_stop.file.press(who="somebody", reason="")
    assert latched(fleet) == ["left"]
    assert (tmp_path / "robots" / "left" / ESTOP_FILE).exists()
    assert not (tmp_path / "robots" / "right-arm" / ESTOP_FILE).exists()


def test_a_stop_of_the_whole_state_directory_stops_all(fleet: Fleet, tmp_path: Path) -> None:
    """As `roboneuron estop` of a single robot's server, or a script, writes it."""
    fleet._look()
    assert latched(fleet) == []
    EmergencyStopLatch(tmp_path / ESTOP_FILE, lambda: 1).press(who="somebody", reason="smoke")
    fleet._look()
    assert latched(fleet) == ["left", "right-arm"]
    assert "smoke" in fleet.robots["left"].loop.emergency_stop.cause()


def test_a_stop_from_before_the_start_holds_for_all(
    make_fleet: Callable[..., Fleet], tmp_path: Path
) -> None:
    EmergencyStopLatch(tmp_path / ESTOP_FILE, lambda: 1).press(who="somebody", reason="")
    fleet = make_fleet()
    fleet._look()  # as `open` does
    assert latched(fleet) == ["left", "right-arm"]


def test_a_robot_whose_latch_cannot_be_written_keeps_no_other_from_stopping(
    fleet: Fleet, tmp_path: Path
) -> None:
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "left").write_text("a file in the place of the folder")
    fleet.press("somebody", "")
    assert (tmp_path / "robots" / "right-arm" / ESTOP_FILE).exists()
    assert latched(fleet) == ["left", "right-arm"]


def test_each_robot_has_an_operator_of_its_own(call: Call, fleet: Fleet) -> None:
    call(fleet, "take_over", {"robot": "left"})
    operators = {}
    for name, robot in fleet.robots.items():
        feature = robot.features.loaded.get("http")
        assert isinstance(feature, HttpFeature)
        assert feature.lease is not None
        operators[name] = feature.lease._operator
    assert operators["left"].startswith(LOCAL_AGENT.who)
    assert operators["right-arm"] == ""


def test_a_call_of_one_robot_renews_the_leases_of_the_client_and_a_client_that_left_has_none(
    make_fleet: Callable[..., Fleet],
) -> None:
    fleet = make_fleet(
        '[http]\nlease_s = 5.0\n[robots.left]\nrobot = "gantry"\n[robots.right]\nrobot = "gantry"\n'
    )
    leases = []
    for robot in fleet.robots.values():
        feature = robot.features.loaded.get("http")
        assert isinstance(feature, HttpFeature)
        assert feature.lease is not None
        leases.append(feature.lease)
        feature.lease.take_over("agent", "admin")
        feature.lease._renewed_s = 0.0
    fleet.events.client.tell("another", True)
    assert [lease._renewed_s for lease in leases] == [0.0, 0.0]
    fleet.events.client.tell("agent", True)
    assert all(lease._renewed_s > 0 for lease in leases)
    for lease in leases:
        lease._lease_s = None
    fleet.events.client.tell("agent", False)
    assert all(lease._is_free() for lease in leases)
    fleet.events.presence.tell("agent", 1)  # a stream of the client, which is one of the fleet's
    assert [lease._open["agent"] for lease in leases] == [1, 1]


def test_a_person_who_is_asked_is_told_which_robot(call: Call, fleet: Fleet) -> None:
    fleet.robots["right-arm"].loop.emergency_stop.file.press(who="somebody", reason="")
    asked: list[str] = []

    async def ask(request: object, params: object, question: str, what: str) -> str:
        asked.append(question)
        return ""

    fleet.server.ask = ask
    fleet.robots["right-arm"].tools.chain.ready = None
    answer = call(fleet, "reset_emergency_stop", {"robot": "right-arm"})
    assert answer.is_error
    assert "the person did not agree" in answer.content[0].text
    assert asked[0].startswith("Robot right-arm: The emergency stop is latched since")


def test_participants_are_looked_for_by_the_modules_of_all_robots() -> None:
    arm = '[robots.a{n}]\nrobot = "gantry"\n[robots.a{n}.inference]\nbackend = "instant"\n'
    registry = fake_registry(FEATURE)
    few, many = (
        parse_config("".join(arm.format(n=n) for n in range(count)), registry=registry)
        for count in (3, 100)
    )
    assert participants_of(few.robots.values()) == 3 * 2 + 8
    assert participants_of(many.robots.values()) == 115
