"""A served gantry with two clients, for tests of client behaviour."""

from __future__ import annotations

import contextlib
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
from anyio.from_thread import BlockingPortal, start_blocking_portal
from fault_loop import JointWitness
from mcp import Client
from mcp.client.streamable_http import streamable_http_client

from rn_testing.waiting import holds_within, wait_until

LEASE_S, SERVER_TIMEOUT_S = 8.0, 1.0
SERVER = """
[server]
transport = "http"
reset_emergency_stop = "client"
[http]
port = {port}
lease_s = {lease_s}
[[http.tokens]]
name = "ann"
role = "admin"
variable = "TEST_ANN"
[[http.tokens]]
name = "bob"
role = "operator"
variable = "TEST_BOB"
"""


class Caller:
    """A connected client whose calls block; usable from any thread."""

    def __init__(self, client: Client, portal: BlockingPortal, name: str) -> None:
        self.name = name
        self._client, self._portal = client, portal

    def answer(self, tool: str, **arguments: Any) -> Any:
        return self._portal.call(self._client.call_tool, tool, arguments)

    def do(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """Structured content of a call that must succeed."""
        answer = self.answer(tool, **arguments)
        assert not answer.is_error, answer.content
        return dict(answer.structured_content)

    def fail(self, tool: str, **arguments: Any) -> str:
        """Code and text of a call that must fail."""
        answer = self.answer(tool, **arguments)
        assert answer.is_error, answer.structured_content
        return f"{answer.meta['roboneuron/error']['code']}: {answer.content[0].text}"

    def module(self, kind: str) -> dict[str, Any]:
        return next(m for m in self.do("get_status")["modules"] if m["module"] == kind)


class Cell:
    """A server in a separate process, two clients, and the gantry's true joints."""

    def __init__(
        self, process: subprocess.Popen[bytes], folder: Path, url: str, witness: JointWitness
    ) -> None:
        self.process, self.folder, self.url, self.witness = process, folder, url, witness
        self.ann: Any = None
        self.bob: Any = None
        self.operator: Any = None
        self.alive = threading.Event()
        self.alive.set()
        self._end = threading.Event()
        self._beats = threading.Thread(target=self._beat, daemon=True)

    @contextlib.contextmanager
    def connected(self) -> Iterator[None]:
        with start_blocking_portal() as portal, contextlib.ExitStack() as stack:
            for name in ("ann", "bob"):
                http = httpx2.AsyncClient(
                    headers={"Authorization": f"Bearer the-token-of-test-{name}"},
                    timeout=60,
                    limits=httpx2.Limits(),
                )
                stack.enter_context(portal.wrap_async_context_manager(http))
                client = Client(streamable_http_client(self.url, http_client=http))
                stack.enter_context(portal.wrap_async_context_manager(client))
                setattr(self, name, Caller(client, portal, name))
            self.operator = self.ann
            self._beats.start()
            yield
            self._end.set()
            self._beats.join(10.0)

    def _beat(self) -> None:
        """Renew the operator's lease; a refusal is an answer too."""
        while not self._end.wait(0.8):
            if self.alive.is_set():
                self.operator.answer("heartbeat")

    def start_loop(self) -> None:
        """Start the missing modules as Ann."""
        for kind in ("robot", "perception", "control"):
            if self.ann.module(kind)["phase"] != "running":
                self.ann.do(f"start_{kind}")
        if self.ann.module("inference")["phase"] != "running":
            self.ann.do("start_inference", instruction="move on")
        if not holds_within(self.witness.moves, 3.0):
            # a busy machine may cause a justified stop, such as silence of the server or an expired
            # lease; the log shows it
            print("the arm stands:", [self.ann.module(kind) for kind in ("robot", "inference")])
            self.ann.do("set_instruction", instruction="move on")
        wait_until(self.witness.moves, 10.0, "the arm moves")
