"""The server tells as a fault when a fallback takes over, and when it gives back; once each."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from roboneuron.modules.inference.execution import ACTING, COUNT, REASON
from roboneuron.tools.loop.fallback import FallbackWatch


class Server:
    """What inference reports, and what is told of it."""

    def __init__(self) -> None:
        self.report: Any = None
        self.told: list[tuple[str, str]] = []
        modules: Any = SimpleNamespace(view=lambda kind: SimpleNamespace(report=self.report))
        self.look = FallbackWatch(modules, lambda *told: self.told.append(told)).look

    def reports(self, acting: str, count: int, reason: str = "") -> None:
        metrics = {ACTING: acting, COUNT: str(count), REASON: reason}
        self.report = SimpleNamespace(metrics=metrics)


@pytest.fixture
def server() -> Server:
    return Server()


def test_each_change_is_told_once(server: Server) -> None:
    server.look()
    server.reports("remote", 0)
    server.look()
    assert not server.told
    server.reports("servo", 1, "no answer within 0.3 s.")
    server.look()
    server.look()
    assert server.told == [("fallback", "servo acts: no answer within 0.3 s.")]
    server.reports("servo", 1, "answers take 0.9 s.")
    server.look()
    server.reports("remote", 1)
    server.look()
    server.look()
    assert server.told[1:] == [("fallback_over", "remote answers in time, and acts again")]


def test_the_next_process_counts_anew(server: Server) -> None:
    server.reports("servo", 1, "late")
    server.look()
    server.report = None
    server.look()
    server.reports("servo", 1, "late")
    server.look()
    assert [what for what, _ in server.told] == ["fallback", "fallback"]


def test_a_policy_alone_tells_nothing(server: Server) -> None:
    server.report = SimpleNamespace(metrics={"backend": "servo"})
    server.look()
    assert not server.told
