"""What tests of several features share."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any

import pytest

from roboneuron.errors import StateError
from roboneuron.server.app import Application
from roboneuron.server.tool import CallContext, NoArguments, Result, Tool


@dataclass
class WaitingTool:
    """The tool `slow`, which works until it is cancelled.

    Attributes:
        ends: number of cancellations.
    """

    begun: threading.Event = field(default_factory=threading.Event)
    cancelled: threading.Event = field(default_factory=threading.Event)
    ends: int = 0

    async def handle(self, _: NoArguments, context: CallContext) -> Result:
        return await context.run(self._work, on_cancel=self._on_cancel)

    def _on_cancel(self) -> None:
        self.ends += 1
        self.cancelled.set()

    def _work(self, _: Any) -> Result:
        self.begun.set()
        if not self.cancelled.wait(60):
            raise StateError("Nobody cancelled it.")
        return Result()


@pytest.fixture
def waiting_tool(application: Application) -> WaitingTool:
    """Give the application of the test the tool `slow`."""
    tool = WaitingTool()
    listed = Tool(
        name="slow",
        title="s",
        description="s",
        arguments=NoArguments,
        result=Result,
        handler=tool.handle,
    )
    application.tools.add_all([listed])
    return tool
