"""A stop that reaches a module is latched for all, though the robot refuses to hold."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NoReturn

import pytest

from roboneuron.errors import NotReadyError
from roboneuron.estop import ESTOP_FILE
from roboneuron.modules import module as module_of_nodes

pytestmark = pytest.mark.ros


def test_a_robot_that_refuses_to_hold_leaves_the_stop_latched(world: Any) -> None:
    node = world.start("robot")
    told: list[bool] = []
    node.module.emergency_stop = told.append

    def refuse() -> NoReturn:
        raise NotReadyError("no joint states come")

    def stop() -> None:
        with pytest.raises(NotReadyError):
            node.trigger_stop("a node")

    hold, node.module.driver.hold = node.module.driver.hold, refuse
    try:
        world.run(stop)
        assert (world.state_directory / ESTOP_FILE).exists()
        assert (node.stopped, told) == (True, [True])
        assert node.needs_start
    finally:
        node.module.driver.hold = hold


def test_a_stop_by_a_signal_ends_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    errors: list[Exception] = []

    def refuse(who: str) -> NoReturn:
        raise NotReadyError("no joint states come")

    monkeypatch.setattr(
        module_of_nodes,
        "TolerantExecutor",
        lambda on_error: SimpleNamespace(add_node=lambda node: None, spin_once=lambda: None),
    )
    node: Any = SimpleNamespace(
        trigger_stop=refuse, status=SimpleNamespace(set_error=errors.append)
    )
    leaving = iter([False, True])

    class Signals:
        @property
        def is_leaving(self) -> bool:
            return next(leaving)

        def take_stop(self) -> bool:
            return True

    signals: Any = Signals()
    module_of_nodes._spin(node, signals)
    assert [str(error) for error in errors] == ["no joint states come"] * 2


def test_a_stop_while_a_permission_is_applied_is_kept(world: Any) -> None:
    node = world.start("robot")
    node.require_start("a fault")
    assert node._why_not_permit(node.stops) == ""
    seen = node.stops
    node.require_start("another fault")  # on the thread that reads the robot
    world.run(lambda: node._permit(seen))
    assert node.needs_start == "another fault"
    world.run(lambda: node._permit(node.stops))
    assert node.needs_start == ""
