"""A RoboNeuron server owned by lerobot's process. It stops with this process in any case, because
its standard input closes.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence

import anyio
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client
from mcp.types import TextContent

from roboneuron import ConfigurationError, NotReadyError, RoboNeuronError

_CALL_TIMEOUT_S = 120.0
_STOP_TIMEOUT_S = 30.0


class OwnServer:
    """Runs `roboneuron serve` and makes it start robot, perception and control."""

    def __init__(self, command: Sequence[str], *, with_perception: bool) -> None:
        """Args:
        command: command line, such as ["roboneuron", "serve", "--config", "fr3.toml"].
        with_perception: True to start perception too.
        """
        self._command = list(command)
        kinds = ("robot", "perception", "control") if with_perception else ("robot", "control")
        self._starts = [f"start_{kind}" for kind in kinds]
        self._ready = threading.Event()
        self._ending = threading.Event()
        self._failure: RoboNeuronError | None = None
        self._thread: threading.Thread | None = None

    def start(self, timeout_s: float) -> None:
        """Start the server and its modules; returns when all are ready.

        Raises:
            ConfigurationError: the server cannot be started.
            NotReadyError: a module did not start; with the server's message.
        """
        self._thread = threading.Thread(target=self._run, name="roboneuron-server", daemon=True)
        self._thread.start()
        if not self._ready.wait(timeout_s):
            self._failure = NotReadyError(f"The server was not ready within {timeout_s:g} s.")
        if self._failure is not None:
            failure = self._failure
            self.stop()
            raise failure

    def stop(self) -> None:
        """Stop the server and its modules; may be called twice."""
        self._ending.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(_STOP_TIMEOUT_S)

    def _run(self) -> None:
        try:
            anyio.run(self._serve)
        except RoboNeuronError as error:
            self._failure = error
        except Exception as error:  # outermost border of the thread: start() raises it
            self._failure = ConfigurationError(
                f"`{' '.join(self._command)}` ended before it answered: {error}.",
                hint="Try the command by itself.",
            )
        self._ready.set()

    async def _serve(self) -> None:
        command, *words = self._command
        server = StdioServerParameters(
            command=command, args=[*words, "--transport", "stdio"], env=dict(os.environ)
        )
        async with Client(stdio_client(server)) as client:
            for tool in self._starts:
                answer = await client.call_tool(tool, {}, read_timeout_seconds=_CALL_TIMEOUT_S)
                if answer.is_error:
                    texts = [part.text for part in answer.content if isinstance(part, TextContent)]
                    raise NotReadyError(f"{tool}: {' '.join(texts)}")
            self._ready.set()
            while not self._ending.is_set():
                await anyio.sleep(0.1)
