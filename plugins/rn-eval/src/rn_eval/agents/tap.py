"""A server with a tap on its connection: records what the agent sends and receives, out of the
agent's reach.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from rn_eval.agents.conduct import ToolCall
from rn_eval.agents.http_tap import HttpTap
from rn_eval.agents.sign import with_sign
from rn_eval.agents.tokens import ReadTexts
from roboneuron import (
    ForeignDataError,
    StateError,
    foreign,
)

_CHUNK = 65536
_MOST_LINE_BYTES = 32 * 1024 * 1024
_MOST_CALLS = 20_000
_ARGUMENTS, _MESSAGE = 2000, 300
_END_S = 10.0
ERROR_META = "roboneuron/error"

Json = dict[str, object]


class ServerTap:
    """One server process for one agent. Started by `start`, ended by `close`.

    Args:
        command: server command.
        environment: the complete environment.
        folder: folder for the socket and the server's log.
        sign: text drawn into every camera image; "" for none.
        port: loopback port on which the command serves HTTP; 0 for a server on stdio.

    Attributes:
        texts: recorded texts, for counting tokens after the episode.
    """

    def __init__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str],
        folder: Path,
        sign: str = "",
        port: int = 0,
    ) -> None:
        self._command, self._environment = list(command), dict(environment)
        self.socket_path = folder / "server.sock"
        self._log = folder / "server.log"
        self._sign, self._port = sign, port
        self._http: HttpTap | None = None
        self._lock = threading.Lock()
        self._begun_s = time.monotonic()
        self._calls: list[ToolCall] = []
        self._open: dict[str, tuple[int, float]] = {}
        self._lists: set[str] = set()
        self.list_bytes = self.other_messages = self.bad_lines = 0
        self.texts = ReadTexts()
        self._server: subprocess.Popen[bytes] | None = None
        self._listener: socket.socket | None = None
        self._links: list[socket.socket] = []
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the server and listen for the agent.

        Raises:
            OSError: the command cannot be started.
            StateError: a server over HTTP does not listen in time.
        """
        self._begun_s = time.monotonic()
        with self._log.open("wb") as log:
            self._server = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=self._environment,
            )
        if self._port:
            self._http = HttpTap(
                self._port, self._note_request, self._note_answer, lambda: self.has_ended
            )
            return
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(self.socket_path))
        self.socket_path.chmod(0o600)
        self._listener.listen(1)
        self._thread = threading.Thread(target=self._serve, name="tap", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """Address for the agent: a URL, or the command of a server on stdio."""
        if self._http is not None:
            return self._http.url
        relay = [sys.executable, "-P", "-m", "rn_eval.agents.relay", str(self.socket_path)]
        return shlex.join(relay)

    @property
    def pid(self) -> int:
        """Process id of the server. Raises StateError before `start`."""
        if self._server is None:
            raise StateError("The server was not started.")
        return self._server.pid

    @property
    def has_ended(self) -> bool:
        """True if the server has ended."""
        return self._server is None or self._server.poll() is not None

    def calls(self) -> tuple[ToolCall, ...]:
        """Calls so far."""
        with self._lock:
            return tuple(self._calls)

    def first_call_s(self, tool: str) -> float | None:
        """Time of the first call of a tool since the start [s]; None if it was not called."""
        return next((call.at_s for call in self.calls() if call.tool == tool), None)

    def now_s(self) -> float:
        """Time since `start` [s]."""
        return time.monotonic() - self._begun_s

    def _serve(self) -> None:
        """Serve one agent; further connections are refused, because a server on stdio has one
        client.
        """
        listener, server = self._listener, self._server
        assert listener is not None
        assert server is not None
        with suppress(OSError):
            link, _ = listener.accept()
            self._links.append(link)
            listener.close()
            threading.Thread(target=self._from_server, args=(link,), daemon=True).start()
            self._from_agent(link)

    def _from_agent(self, link: socket.socket) -> None:
        server = self._server
        assert server is not None
        assert server.stdin is not None
        pending = b""
        with suppress(OSError):
            while data := link.recv(_CHUNK):
                *lines, pending = (pending + data).split(b"\n")
                for line in lines:
                    self._note_request(line)
                    server.stdin.write(line + b"\n")
                server.stdin.flush()
                if len(pending) > _MOST_LINE_BYTES:
                    break
        with suppress(OSError, ValueError):
            self._cancel_what_is_left(server.stdin)

    def _cancel_what_is_left(self, server: IO[bytes]) -> None:
        """Cancel the open calls of an agent that has disconnected.

        Closing the server's input would cancel them too, but would also end the simulation before
        it is judged.
        """
        with self._lock:
            left = list(self._open)
        for number in left:
            note = {
                "jsonrpc": "2.0",
                "method": "notifications/cancelled",
                "params": {"requestId": json.loads(number), "reason": "the agent has gone"},
            }
            server.write(json.dumps(note).encode() + b"\n")
        server.flush()

    def _from_server(self, link: socket.socket) -> None:
        server = self._server
        assert server is not None
        assert server.stdout is not None
        for line in server.stdout:
            if _message(line) is None:
                self._count_bad()  # which the agent gets all the same
            sent = self._note_answer(line)
            with suppress(OSError):
                link.sendall(sent)
        with suppress(OSError):
            link.shutdown(socket.SHUT_RDWR)

    def _note_request(self, line: bytes, exchange: str = "") -> None:
        message = _message(line)
        if message is None:
            if line.strip():
                self._count_bad()
            return
        number = exchange + json.dumps(message.get("id"))
        if message.get("method") == "tools/list":
            self._lists.add(number)
        if message.get("method") != "tools/call":
            self.other_messages += 1
            return
        parameters = message.get("params")
        asked = parameters if isinstance(parameters, dict) else {}
        self.texts.note(self.texts.requests, asked)
        call = ToolCall(
            at_s=round(self.now_s(), 4),
            tool=str(asked.get("name"))[:100],
            arguments=json.dumps(asked.get("arguments") or {})[:_ARGUMENTS],
            request_bytes=len(line),
        )
        with self._lock:
            if len(self._calls) < _MOST_CALLS:
                self._open[number] = (len(self._calls), time.monotonic())
                self._calls.append(call)

    def _note_answer(self, line: bytes, exchange: str = "") -> bytes:
        """Record an answer, and return what the agent receives."""
        message = _message(line)
        if message is None:
            return line
        sent = line
        if self._sign and b'"image"' in line:
            signed = with_sign(message, self._sign)
            sent = json.dumps(signed, separators=(",", ":")).encode() + b"\n"
        if "method" not in message:
            number = exchange + json.dumps(message.get("id"))
            if number in self._lists:
                self._lists.discard(number)
                self.list_bytes += len(line)
                self.texts.note(self.texts.lists, message.get("result"))
            self._close_call(number, message, len(line))
        return sent

    def _count_bad(self) -> None:
        with self._lock:
            self.bad_lines += 1

    def _close_call(self, number: str, message: Json, size: int) -> None:
        error = _error_of(message)
        with self._lock:
            index, sent_s = self._open.pop(number, (-1, 0.0))
            if index < 0:
                return
            self._calls[index] = self._calls[index].model_copy(
                update={
                    "took_s": round(time.monotonic() - sent_s, 4),
                    "answer_bytes": size,
                    **error,
                }
            )
        self.texts.note_answer(message.get("result"))

    def close(self) -> None:
        """End the server as a client does, by closing its input; kill it if it hangs. May be called
        twice.
        """
        if self._http is not None:
            self._http.close()
            self._http = None
            if self._server is not None:
                self._server.terminate()  # because a server over HTTP does not end with its input
        for link in self._links:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()
        self._links.clear()
        if self._listener is not None:
            with suppress(OSError):  # closing alone would leave the thread blocked in `accept`
                self._listener.shutdown(socket.SHUT_RDWR)
            self._listener.close()
        server = self._server
        if server is None:
            return
        with suppress(OSError, ValueError):
            assert server.stdin is not None
            server.stdin.close()
        for stop in (None, server.terminate, server.kill):
            if stop is not None:
                stop()
            with suppress(subprocess.TimeoutExpired):
                server.wait(_END_S)
                break
        if self._thread is not None:
            self._thread.join(_END_S)
        if server.stdout is not None:
            server.stdout.close()


def _message(line: bytes) -> Json | None:
    """Parse a line of either side; None if it is no JSON object."""
    try:
        message = foreign.decode_json(line, "a line", most_bytes=_MOST_LINE_BYTES)
    except ForeignDataError:
        return None
    return message if isinstance(message, dict) else None


def _error_of(message: Json) -> dict[str, str]:
    """`ToolCall` fields for the error of an answer; empty if it is no error."""
    error = message.get("error")
    if isinstance(error, dict):
        return {"code": "protocol", "message": str(error.get("message", ""))[:_MESSAGE]}
    result = message.get("result")
    if not isinstance(result, dict) or not result.get("isError"):
        return {}
    meta = result.get("_meta")
    told = meta.get(ERROR_META) if isinstance(meta, dict) else None
    if not isinstance(told, dict):
        return {"code": "unknown"}
    text = f"{told.get('message', '')} {told.get('hint', '')}".strip()
    words = {name: str(told.get(name, "")) for name in ("path", "rule")}
    return {"code": str(told.get("code", "unknown")), "message": text[:_MESSAGE], **words}


def module_pid(server: int, module: str) -> int | None:
    """Process id of a server's module, found by its log file; None if it does not run."""
    with suppress(OSError):
        children = Path(f"/proc/{server}/task").glob("*/children")
        for child in (int(word) for path in children for word in path.read_text().split()):
            with suppress(OSError):
                if Path(os.readlink(f"/proc/{child}/fd/1")).name == f"{module}.log":
                    return child
    return None


def end_module(pid: int, kind: str) -> None:
    """Kill or suspend a module process; it may already have ended."""
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL if kind == "kill" else signal.SIGSTOP)
