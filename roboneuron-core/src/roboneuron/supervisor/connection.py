"""The server's ROS node, opened in the background."""

from __future__ import annotations

import itertools
import logging
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron.errors import NotReadyError, StateError
from roboneuron.ros.environment import prepare_environment
from roboneuron.ros.graph import server_node
from roboneuron.ros.topics import DIAGNOSTICS

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray

    from roboneuron.ros.link import RosLink


log = logging.getLogger(__name__)
_OPEN_TIMEOUT_S = 30.0
"""Timeout of opening: joining takes half a second; importing rclpy from a cold disk takes many
times that.
"""


class Connection:
    """Open the link once, on a background thread; `link` waits for it. Usable from any thread.

    Args:
        on_status: called with each message of /diagnostics, on the link's thread.
        log_directory: ROS logs go to its `ros` folder.

    Attributes:
        starts: counter of module processes per node name, which gives each its own ports.
    """

    def __init__(self, on_status: Callable[[DiagnosticArray], None], log_directory: Path) -> None:
        self._on_status = on_status
        self._log_directory = log_directory
        # a thread starts only once: of several callers of `begin` one starts it, and after `close`
        # none
        self._lock = threading.Lock()
        self._opened: Future[RosLink] = Future()
        self._opening = threading.Thread(target=self._open, name="ros-open", daemon=True)
        self._closed = False
        self.starts = itertools.count(os.getpid())

    def begin(self) -> None:
        """Start opening in the background; does nothing the second time.

        Raises:
            StateError: the server is shutting down.
        """
        with self._lock:
            if self._closed:
                raise StateError("The server is shutting down.")
            if self._opening.ident is None:
                self._opening.start()

    def link(self) -> RosLink:
        """The open link.

        Raises:
            ConfigurationError: the environment mixes two ROS installations.
            StateError: the server is shutting down.
            NotReadyError: joining takes unusually long; it goes on in the background.
        """
        self.begin()
        try:
            return self._opened.result(timeout=_OPEN_TIMEOUT_S)
        except TimeoutError as error:
            raise NotReadyError(
                f"The ROS graph was not joined within {_OPEN_TIMEOUT_S:g} s.", hint="Retry."
            ) from error

    def close(self) -> None:
        """Leave the graph; idempotent."""
        with self._lock:
            self._closed = True
        has_begun = self._opening.ident is not None
        if has_begun and self._opened.exception(timeout=_OPEN_TIMEOUT_S) is None:
            self._opened.result().close()

    def _open(self) -> None:
        """Import rclpy and join the graph."""
        try:
            # before rclpy is imported, which reads the environment
            prepare_environment(self._log_directory / "ros")
            from diagnostic_msgs.msg import DiagnosticArray  # heavy

            from roboneuron.ros.link import RosLink  # heavy

            link = RosLink(server_node(os.getpid()), _end_process)
            link.open()
            link.subscribe(DiagnosticArray, DIAGNOSTICS, self._on_status)
        except BaseException as error:  # raised again in `link`
            self._opened.set_exception(error)
        else:
            self._opened.set_result(link)


def _end_process() -> None:
    """End this server as SIGTERM does: without its ROS thread it can neither watch nor command the
    modules, which hold at their server's end.
    """
    log.critical("The ROS thread has ended: the server ends, and the modules with it.")
    os.kill(os.getpid(), signal.SIGTERM)


Connect = Callable[[Callable[["DiagnosticArray"], None], Path], Connection]
