"""A module that is frozen or gone cannot say so itself: the server does, on /diagnostics."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from roboneuron.direct_path.feature import HealthDiagnostics
from roboneuron.supervisor.health import Health, ModuleView

PLAN = SimpleNamespace(config=SimpleNamespace(namespace="cell"))


class Link:
    """Keeps what is published."""

    def __init__(self) -> None:
        self.advertised: list[str] = []
        self.sent: list[DiagnosticArray] = []

    def advertise(self, message_type: type, topic: str) -> Any:
        self.advertised.append(topic)
        return self.sent.append


@pytest.mark.parametrize(
    ("health", "level"),
    [
        ("ok", DiagnosticStatus.OK),
        ("silent", DiagnosticStatus.STALE),
        ("stuck", DiagnosticStatus.STALE),
        ("exited", DiagnosticStatus.ERROR),
    ],
)
def test_a_change_is_told_with_its_level(health: Health, level: Any) -> None:
    link = Link()
    told = HealthDiagnostics(lambda: cast(Any, link))
    view = ModuleView(kind="control", phase="running", plan=cast(Any, PLAN))
    for _ in range(2):
        told.publish(view, "starting", health)
    assert link.advertised == ["/diagnostics"]
    (status,) = link.sent[-1].status
    assert (status.name, status.level) == ("cell/supervisor/control", level)
    assert {value.key: value.value for value in status.values} == {
        "health": health,
        "before": "starting",
    }


def test_a_module_that_was_never_chosen_is_not_told() -> None:
    link = Link()
    told = HealthDiagnostics(lambda: cast(Any, link))
    told.publish(ModuleView(kind="control", phase="stopped"), "ok", "stopped")
    assert link.advertised == []
