"""The server's ROS node, and how module processes are started."""

from __future__ import annotations

import itertools
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron.errors import ConfigurationError, NotReadyError, StateError
from roboneuron.modules.settings import ModuleKind
from roboneuron.ros.environment import (
    check_state_directory,
    module_environment,
    prepare_environment,
)
from roboneuron.ros.topics import DIAGNOSTICS
from roboneuron.supervisor.process import ModuleProcess, ProcessEvents, spawn

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray

    from roboneuron.ros.link import RosLink


_OPEN_TIMEOUT_S = 30.0
"""Joining takes half a second; importing rclpy from a cold disk takes many times that."""


class Connection:
    """Opens the link once, on a thread of its own; `link` waits for it. Usable from any thread.

    Args:
        on_status: called with each message of /diagnostics, on the link's thread.
        log_directory: ROS logs go to its `ros` folder.

    Attributes:
        starts: numbers the module processes of one node, for ports of their own.
    """

    def __init__(self, on_status: Callable[[DiagnosticArray], None], log_directory: Path) -> None:
        self._on_status = on_status
        self._log_directory = log_directory
        self._lock = threading.Lock()
        self._opened: Future[RosLink] | None = None
        self._closed = False
        self.starts = itertools.count(os.getpid())

    def begin(self) -> None:
        """Start opening; returns at once, and does nothing the second time.

        Raises:
            StateError: the server is shutting down.
        """
        with self._lock:
            if self._closed:
                raise StateError("The server is shutting down.")
            if self._opened is not None:
                return
            self._opened = Future()
            threading.Thread(
                target=self._open, args=(self._opened,), name="ros-open", daemon=True
            ).start()

    def link(self) -> RosLink:
        """The open link.

        Raises:
            ConfigurationError: the environment mixes two ROS installations.
            StateError: the server is shutting down.
            NotReadyError: joining takes unusually long; it goes on in the background.
        """
        self.begin()
        assert self._opened is not None
        try:
            return self._opened.result(timeout=_OPEN_TIMEOUT_S)
        except FutureTimeoutError as error:
            raise NotReadyError(
                f"The ROS graph was not joined within {_OPEN_TIMEOUT_S:g} s.", hint="Retry."
            ) from error

    def close(self) -> None:
        """Leave the graph; idempotent."""
        with self._lock:
            self._closed = True
            opened = self._opened
        if opened is not None and opened.exception(timeout=_OPEN_TIMEOUT_S) is None:
            opened.result().close()

    def _open(self, opened: Future[RosLink]) -> None:
        """Import rclpy and join the graph.

        Args:
            opened: gets the link, or why there is none.
        """
        try:
            # before rclpy is imported, which reads the environment
            prepare_environment(self._log_directory / "ros")
            from diagnostic_msgs.msg import DiagnosticArray  # heavy

            from roboneuron.ros.link import RosLink  # heavy

            link = RosLink(f"roboneuron_server_{os.getpid()}")
            link.open()
            link.subscribe(DiagnosticArray, DIAGNOSTICS, self._on_status)
        except BaseException as error:  # handed to whoever asks for the link
            opened.set_exception(error)
        else:
            opened.set_result(link)


Stage = Callable[[str], None]
Command = Callable[[str | None], Sequence[str]]
Connect = Callable[[Callable[["DiagnosticArray"], None], Path], Connection]


def module_command(python: str | None) -> list[str]:
    """How a module process is started; `-P` keeps the working directory out of its import path."""
    return [python or sys.executable, "-u", "-P", "-m", "roboneuron.modules"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Launch:
    """One start of a module process, without the configuration: that is in `first_line`.

    Attributes:
        kind: which module.
        node_name: its ROS node under the robot's namespace; names its process and its log too.
        status_name: under which it reports.
        first_line: its settings as JSON, for its stdin.
        python: interpreter of its own environment; None for the server's.
        start_timeout_s: from the spawn to the proof that it works [s].
        stop_timeout_s: from SIGTERM to SIGKILL, when the start fails [s].
    """

    kind: ModuleKind
    node_name: str
    status_name: str
    first_line: str
    python: str | None
    start_timeout_s: float
    stop_timeout_s: float


class Spawner:
    """Starts module processes, on a thread that lives as long as the server: PR_SET_PDEATHSIG
    follows the thread.

    Args:
        command: how to start a module under a given interpreter.
        connection: the server's node.
        log_directory: where modules log, one file for each.

    Attributes:
        events: what happens to module processes, for listeners.
        secret_variables: environment variables that modules do not get.
    """

    def __init__(self, command: Command, connection: Connection, log_directory: Path) -> None:
        self.connection = connection
        self.log_directory = log_directory
        self.events = ProcessEvents()
        self.secret_variables: set[str] = set()
        self._command = command
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="spawner")

    def start(self, launch: Launch) -> ModuleProcess:
        """Start a module process.

        Raises:
            ConfigurationError: it cannot be started, or its log cannot be written.
        """
        number = next(self.connection.starts)
        command = self._command(launch.python)
        check_state_directory(self.log_directory)
        try:
            return self._thread.submit(
                spawn,
                launch.node_name,
                command,
                module_environment(launch.python, number, self.secret_variables),
                launch.first_line,
                self.log_directory / f"{launch.node_name}.log",
                self.events,
            ).result()
        except OSError as error:
            raise ConfigurationError(
                f"The {launch.kind} process cannot be started with {command[0]!r}: "
                f"{error.strerror or error}.",
                hint=f"Check `python` in the section [{launch.kind}] of the configuration.",
            ) from error

    def shutdown(self) -> None:
        """End the thread; a process that is still there gets its death signal."""
        self._thread.shutdown()
