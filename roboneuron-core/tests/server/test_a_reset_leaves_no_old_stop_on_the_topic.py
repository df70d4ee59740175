"""The message that the emergency stop's topic keeps for late subscribers matches the file."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from roboneuron.estop import ESTOP_FILE, EmergencyStopLatch
from roboneuron.estop.emergency import EmergencyStop
from roboneuron.gate.audit import AuditLog


class Topic:
    """A topic that keeps its last message for those who subscribe later (transient local)."""

    def __init__(self) -> None:
        self.last: Any = None
        self.listeners: list[Callable[[Any], None]] = []

    def advertise(self, message_type: type, topic: str, qos: Any) -> Callable[[Any], None]:
        def publish(message: Any) -> None:
            self.last = message
            for listener in self.listeners:
                listener(message)

        return publish

    def subscribe(
        self, message_type: type, topic: str, callback: Callable[[Any], None], qos: Any
    ) -> None:
        self.listeners.append(callback)
        if self.last is not None:
            callback(self.last)

    def on_executor(self, task: Callable[[], Any]) -> Any:
        return task()


def server(folder: Path, topic: Topic) -> EmergencyStop:
    return EmergencyStop(cast(Any, SimpleNamespace(state_directory=folder, link=topic, views=list)))


def test_a_second_server_is_not_stopped_by_a_stop_that_a_person_has_released(
    tmp_path: Path,
) -> None:
    pytest.importorskip("rclpy")
    topic = Topic()
    first = server(tmp_path, topic)
    first.prepare("arm")
    first.file.press(who="ann", reason="smoke")
    assert topic.last.data is True
    person = EmergencyStopLatch(tmp_path / ESTOP_FILE, time.time_ns)
    person.reset(who="ann", role="admin", audit=AuditLog(tmp_path / "audit.jsonl", time.time_ns))
    first.follow_file()  # as the server does every 30 ms
    assert topic.last.data is False
    second = server(tmp_path, topic)
    second.prepare("arm")
    assert not second.file.is_latched()
    assert not first.is_latched()


def test_a_stop_that_stands_stays_on_the_topic(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    topic = Topic()
    first = server(tmp_path, topic)
    first.prepare("arm")
    first.file.press(who="ann", reason="smoke")
    first.follow_file()
    assert topic.last.data is True
