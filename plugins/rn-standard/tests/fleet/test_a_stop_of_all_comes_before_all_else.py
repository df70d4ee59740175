"""What stops the last robot is sent before anything is written, synced or woken for the first."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from mcp import types

from rn_standard.fleet.fleet import Fleet
from roboneuron.direct_path.feature import direct_path
from roboneuron.estop import ESTOP_FILE
from roboneuron.feature import ExposedEndpoint

Call = Callable[..., types.CallToolResult]
STOPS = [("stop", "left"), ("stop", "right-arm")]


@pytest.fixture
def order(fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """What happens while both robots move: a stop sent, a latch created, the topic told, a thread
    woken, a sync.
    """
    seen: list[tuple[str, str]] = []
    create, sync = os.open, os.fsync

    def opened(path: Any, flags: int, *more: Any, **named: Any) -> int:
        descriptor = create(path, flags, *more, **named)
        if flags & os.O_CREAT and str(path).endswith(ESTOP_FILE):
            seen.append(("file", Path(path).parent.name))
        return descriptor

    monkeypatch.setattr(os, "open", opened)
    monkeypatch.setattr(
        os, "fsync", lambda descriptor: (seen.append(("sync", "")), sync(descriptor))
    )
    for name, robot in fleet.robots.items():
        publishers = robot.loop.emergency_stop._publishers
        publishers[name] = lambda is_latched, name=name: seen.append(("topic", name))  # type: ignore[misc]
    return seen


@pytest.fixture
def moving(fleet: Fleet, order: list[tuple[str, str]]) -> Any:
    """Both robots move."""

    class Halt(threading.Event):
        def __init__(self, name: str) -> None:
            super().__init__()
            self.name = name

        def set(self) -> None:
            order.append(("wake", self.name))
            super().set()

    with ExitStack() as stack:
        for name, robot in fleet.robots.items():
            exposed = cast(
                ExposedEndpoint,
                SimpleNamespace(
                    robot=name,
                    topic="cmd_vel",
                    namespace=name,
                    label="drive",
                    moves=True,
                    control_input="",
                ),
            )
            motion = stack.enter_context(
                direct_path(robot.host).arbiter.claim(exposed, "a test", Halt(name))
            )
            motion.stop_now = lambda name=name: order.append(("stop", name))  # type: ignore[misc]
        yield


@pytest.mark.usefixtures("moving")
def test_every_robot_is_told_to_stand_then_latched_then_the_rest(
    fleet: Fleet, order: list[tuple[str, str]]
) -> None:
    fleet.press("somebody", "a test")
    assert order[:4] == [*STOPS, ("file", "left"), ("file", "right-arm")]
    assert sorted(order[4:]) == sorted(
        (what, name) for what in ("topic", "wake") for name in fleet.robots
    )


@pytest.mark.usefixtures("moving")
def test_modules_are_told_before_any_disk_is_waited_for(
    fleet: Fleet, order: list[tuple[str, str]]
) -> None:
    for robot in fleet.robots.values():
        robot.loop.emergency_stop._tell = lambda *_: ([], [], 0.0)  # type: ignore[method-assign]
    fleet.latch("somebody", "a test")
    assert [what for what, _ in order].index("sync") > max(
        order.index(("topic", name)) for name in fleet.robots
    )
    assert order.count(("sync", "")) == 4  # the latch of each robot, and its folder


def test_a_stop_comes_before_the_leases_of_its_client(call: Call, fleet: Fleet) -> None:
    seen: list[bool] = []
    fleet.events.client.listen(
        lambda who, is_there: seen.append(
            all(r.loop.emergency_stop.file.is_latched() for r in fleet.robots.values())
        )
    )
    for robot in fleet.robots.values():
        robot.loop.emergency_stop.latch = lambda *_, **__: ([], 0.0)  # type: ignore[method-assign]
    call(fleet, "emergency_stop")
    assert seen[0]


@pytest.mark.usefixtures("moving")
def test_a_latch_that_cannot_be_written_keeps_no_other_from_its_place(
    fleet: Fleet, order: list[tuple[str, str]], tmp_path: Path
) -> None:
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "left").write_text("a file in the place of the folder")
    fleet.press("somebody", "")
    assert order[:3] == [*STOPS, ("file", "right-arm")]
    assert {("topic", "left"), ("wake", "left")} <= set(order)


def test_stop_motion_without_a_robot_ends_the_motions_of_all(
    call: Call, make_fleet: Callable[..., Fleet]
) -> None:
    fleet = make_fleet()
    stops = {name: robot.loop.starts.arm_stops for name, robot in fleet.robots.items()}
    answer = call(fleet, "stop_motion")
    assert answer.structured_content is not None, answer.content
    assert set(answer.structured_content["robots"]) == set(fleet.robots)
    for name, robot in fleet.robots.items():
        assert robot.loop.starts.arm_stops > stops[name]
        assert not robot.loop.emergency_stop.is_latched()


def test_stop_motion_of_one_robot_leaves_the_other_alone(
    call: Call, make_fleet: Callable[..., Fleet]
) -> None:
    fleet = make_fleet()
    stops = {name: robot.loop.starts.arm_stops for name, robot in fleet.robots.items()}
    assert not call(fleet, "stop_motion", {"robot": "left"}).is_error
    assert fleet.robots["left"].loop.starts.arm_stops > stops["left"]
    assert fleet.robots["right-arm"].loop.starts.arm_stops == stops["right-arm"]
