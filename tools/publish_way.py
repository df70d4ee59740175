"""The way of `publish_velocity`, from the client's line to the publisher of its topic, in this
process: the server is real, ROS is not joined, and what rclpy would publish is only noted.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import patch

import anyio
from anyio import to_thread
from way_count import Call, Recorder, Way

from roboneuron import Host
from roboneuron.config import parse_config
from roboneuron.server.app import Application
from roboneuron.supervisor.connection import Connection

WAIT_S = 30.0
"""Longest wait for an answer."""
CONFIG = """
[robot]
name = "rover"
[supervisor]
state_directory = {folder}
[[expose]]
name = "velocity"
kind = "publish"
topic = "cmd_vel"
type = "geometry_msgs/msg/Twist"
bounds = {{ "linear.x" = [-1, 1], "angular.z" = [-2, 2] }}
stop_message = {stop}
repeat_hz = {repeat_hz}
"""
_TWIST = {"linear": {"x": 0.1, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}}


class NotedPublisher:
    """Stands for rclpy's publisher and node: one subscription is matched, messages are noted.

    Attributes:
        sent: the messages.
        on_publish: called before each.
    """

    def __init__(self) -> None:
        self.sent: list[object] = []
        self.on_publish: Callable[[], object] = lambda: None

    def get_subscription_count(self) -> int:
        """One."""
        return 1

    def publish(self, message: object) -> None:
        """Note a message."""
        self.on_publish()
        self.sent.append(message)


class Unjoined(Connection):
    """A connection that joins no graph; all its publishers are `publisher`."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.publisher = NotedPublisher()
        node = SimpleNamespace(
            get_subscriptions_info_by_topic=lambda topic: [],
            create_publisher=lambda *arguments, **named: self.publisher,
        )
        self._link: Any = SimpleNamespace(
            node=node,
            on_executor=lambda task: task(),
            advertise=lambda *arguments: lambda message: None,
            subscribe=lambda *arguments: lambda: None,
            create=lambda noun, name, ros_type, make: make(node),
            send_if_possible=lambda publisher, message: publisher.publish(message),
        )

    def begin(self) -> None:
        """Join nothing."""

    def close(self) -> None:
        """Leave nothing."""

    def link(self) -> Any:
        """The node."""
        return self._link


def trace_publish(folder: Path, *, lasting: bool) -> Way:
    """The way of a call of `publish_velocity`, after two others that fill the caches.

    Args:
        folder: for the state of the server.
        lasting: the value lasts and ends with a stop message, as for a base; else one message.

    Raises:
        AssertionError: a call failed, or published nothing.
    """
    text = CONFIG.format(
        folder=json.dumps(str(folder)),
        stop=json.dumps("zero" if lasting else ""),
        repeat_hz=20.0 if lasting else 0.0,
    )
    application = Application(parse_config(text), connect=Unjoined)
    recorder = Recorder()
    try:
        with patch.object(
            Host, "end_soon", staticmethod(lambda: None)
        ):  # it would end this process
            anyio.run(_call, application, recorder, lasting)
    finally:
        recorder.remove()
        application.close()
    return carried(recorder.calls)


async def _call(application: Application, recorder: Recorder, lasting: bool) -> None:
    incoming, outgoing = os.pipe(), os.pipe()
    answers = iter(os.fdopen(outgoing[0]).readline, "")
    publisher: NotedPublisher = application.supervisor.connection.publisher  # type: ignore[attr-defined]
    transport = application.listen((incoming[0], outgoing[1]))

    def stop() -> None:
        recorder.is_on = False

    def client() -> None:
        def ask(number: int, method: str, params: dict[str, Any]) -> dict[str, Any]:
            told = {"jsonrpc": "2.0", "id": number, "method": method, "params": params}
            os.write(incoming[1], json.dumps(told).encode() + b"\n")
            while (answer := json.loads(next(answers))).get("id") != number:
                pass
            return cast("dict[str, Any]", answer["result"])

        try:
            info = {"name": "trace", "version": "1"}
            ask(
                0,
                "initialize",
                {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": info},
            )
            arguments = {"message": _TWIST} | ({"duration_s": 0.02} if lasting else {})
            for number in range(1, 4):
                sent = len(publisher.sent)
                if number == 3:
                    publisher.on_publish = stop
                    recorder.is_on = True
                answer = ask(
                    number, "tools/call", {"name": "publish_velocity", "arguments": arguments}
                )
                assert not answer.get("isError"), answer
                assert len(publisher.sent) > sent
        finally:
            os.close(incoming[1])

    async def serve() -> None:
        await transport(anyio.Event())

    recorder.install()
    with anyio.fail_after(WAIT_S):
        async with anyio.create_task_group() as group:
            group.start_soon(serve)
            await to_thread.run_sync(client, abandon_on_cancel=True)


def carried(calls: list[Call]) -> Way:
    """Of these calls those on the threads that carry the message: the reader of the client's line,
    the event loop until it hands over to a worker, the worker.
    """
    readers = [call for call in calls if call.thread == "mcp-stdin"]
    workers = [call for call in calls if "worker" in call.thread]
    loop = [
        call
        for call in calls
        if call.thread == "MainThread" and (not workers or call.at_ns < workers[0].at_ns)
    ]
    return Way([*readers, *loop, *workers])


def main() -> None:
    """Print both ways, or with --json their counts."""
    ways: dict[str, Way] = {}
    for name, lasting in (("once", False), ("lasting", True)):
        with tempfile.TemporaryDirectory() as folder:
            ways[name] = trace_publish(Path(folder), lasting=lasting)
    if "--json" in sys.argv:
        print(json.dumps({name: way.counts() for name, way in ways.items()}))
        return
    for name, way in ways.items():
        print(f"publish_velocity, {name}: {way.told()}\n{way.listing()}")


if __name__ == "__main__":
    main()
