"""Robot side of the FCI as a child process: franka-sim, or the strict box in front of it."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

from roboneuron import NotReadyError

_START_S = 60.0
_STOP_S = 20.0
_QUESTION_S = 2.0
_LOOK_S = 0.1


class Counterpart(ABC):
    """A context manager: runs while open, and answers requests on a UDP port.

    Args:
        host: address of 127.0.0.0/8 to serve on.
        asking_port: UDP port for requests.
        log: file for its output.

    Attributes:
        host: as given.
        process: the child process, once started.
    """

    name: ClassVar[str]
    priority: ClassVar[int]
    """SCHED_FIFO priority, if the system grants it."""

    def __init__(self, host: str, asking_port: int, log: Path) -> None:
        self.host = host
        self.process: subprocess.Popen[bytes] | None = None
        self._asking_port = asking_port
        self._log = log

    @abstractmethod
    def command(self) -> Sequence[str]:
        """Command line of the process."""

    def is_serving(self) -> bool:
        """Check that it is ready; called once it answers requests. Raises OSError."""
        return True

    def __enter__(self) -> Self:
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with self._log.open("wb") as output:
            process = self.process = subprocess.Popen(
                self.command(), stdout=output, stderr=subprocess.STDOUT, start_new_session=True
            )
        # a control box has its own computer, so it should not wait for other processes
        with contextlib.suppress(OSError):
            os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(self.priority))
        deadline_s = time.monotonic() + _START_S
        while not self._answers():
            if process.poll() is not None or time.monotonic() > deadline_s:
                self.__exit__(None, None, None)
                tail = self._log.read_text(encoding="utf-8", errors="replace")[-800:]
                raise NotReadyError(f"{self.name} did not start: {tail}")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        process = self.process
        if process is None or process.poll() is not None:
            return
        process.terminate()
        try:
            process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def tell(self, **what: float) -> dict[str, Any]:
        """Request its state, or send it commands; see the program's docstring. Raises OSError."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            asking.settimeout(_QUESTION_S)
            asking.connect((self.host, self._asking_port))
            asking.send(json.dumps(what).encode())
            answer: dict[str, Any] = json.loads(asking.recv(65536))
            return answer

    def _answers(self) -> bool:
        try:
            return bool(self.tell()) and self.is_serving()
        except OSError:
            time.sleep(_LOOK_S)
            return False
