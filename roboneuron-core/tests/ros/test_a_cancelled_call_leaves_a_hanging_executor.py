"""A call whose work waits for a ROS executor that hangs: cancelled, it ends at once, its thread
within the executor's bound, and the server answers others.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import anyio
import pytest
from mcp import Client
from std_msgs.msg import Bool

from roboneuron.errors import InternalError, RoboNeuronError
from roboneuron.ros.environment import prepare_environment
from roboneuron.ros.link import RosLink
from roboneuron.server.app import Application
from roboneuron.server.tool import CallContext, NoArguments, Result, Tool

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]
BOUND_S = 3.0
SOON_S = 20.0
"""More than a call needs on a busy machine."""
TOPIC = "/of_the_call"


class Nothing(Result):
    """An empty answer."""


class Calls:
    """A tool whose work needs the executor, and one whose work does not."""

    def __init__(self, link: RosLink) -> None:
        self._link = link
        self.begun, self.cancelled, self.ended = (threading.Event() for _ in range(3))
        self.errors: list[str] = []

    def _subscribe(self, stage: object) -> None:
        self.begun.set()
        try:
            self._link.subscribe(Bool, TOPIC, lambda _: None)()
        except RoboNeuronError as error:
            self.errors.append(error.code)
            raise
        finally:
            self.ended.set()

    async def hear(self, _: NoArguments, context: CallContext) -> Nothing:
        await context.run(self._subscribe, on_cancel=self.cancelled.set)
        return Nothing()

    async def think(self, _: NoArguments, context: CallContext) -> Nothing:
        await context.run(lambda stage: None)
        return Nothing()


@pytest.fixture
def link(tmp_path: Path) -> Iterator[RosLink]:
    prepare_environment(tmp_path / "ros")
    made = RosLink("hangs")
    made.open()
    yield made
    made.close()


@pytest.fixture
def hangs(link: RosLink, monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """The executor hangs until this is set."""
    monkeypatch.setattr("roboneuron.ros.link._TASK_TIMEOUT_S", BOUND_S)
    begun, free = threading.Event(), threading.Event()

    def hang() -> None:
        begun.set()
        free.wait()

    def hold() -> None:
        with suppress(InternalError):  # this thread gives up as every other
            link.on_executor(hang)

    holder = threading.Thread(target=hold)
    holder.start()
    assert begun.wait(SOON_S)
    yield free
    free.set()
    holder.join(SOON_S)


def test_a_cancelled_call_ends_at_once_and_the_server_lives(
    application_of: Callable[..., Application], link: RosLink, hangs: threading.Event
) -> None:
    application, calls = application_of(), Calls(link)
    for name, handler in (("hear", calls.hear), ("think", calls.think)):
        application.tools.add_all(
            [
                Tool(
                    name=name,
                    title="Test",
                    description="Test.",
                    arguments=NoArguments,
                    result=Nothing,
                    handler=handler,
                )
            ]
        )

    async def scenario() -> None:
        async with Client(application.server) as client:
            async with anyio.create_task_group() as group:
                group.start_soon(client.call_tool, "hear", {})
                await anyio.to_thread.run_sync(calls.begun.wait, SOON_S)
                group.cancel_scope.cancel()
            assert await anyio.to_thread.run_sync(calls.cancelled.wait, SOON_S)
            assert not calls.ended.is_set(), "it has waited for the executor"
            assert not (await client.call_tool("think", {})).is_error
            assert await anyio.to_thread.run_sync(calls.ended.wait, SOON_S)
            assert calls.errors == ["internal"]
            assert (await client.call_tool("hear", {})).is_error, "nobody waits again"
            hangs.set()
            with anyio.fail_after(SOON_S):
                while (await client.call_tool("hear", {})).is_error:
                    await anyio.sleep(0.02)

    anyio.run(scenario)
