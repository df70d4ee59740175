"""The box as a child process; a context manager beside `FrankaSim`."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from rn_robot_fr3.fci.box.proxy import ASKING_PORT
from roboneuron import NotReadyError

_START_S = 20.0
_STOP_S = 5.0
_PRIORITY = 29


class ControlBox:
    """Serves the FCI on `host` and is a client of franka-sim at `upstream`.

    Args:
        host, upstream: addresses of 127.0.0.0/8.
        log: where its output goes.
        seed: of its losses.
    """

    def __init__(self, host: str, upstream: str, log: Path, seed: int = 1) -> None:
        self.host, self._upstream, self._log, self._seed = host, upstream, log, seed
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> ControlBox:
        command = [sys.executable, "-m", "rn_robot_fr3.fci.box.proxy", "--host", self.host]
        command += ["--upstream", self._upstream, "--seed", str(self._seed)]
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with self._log.open("wb") as output:
            self._process = subprocess.Popen(
                command, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
            )
        # a control box has a computer of its own: let it not wait for others here
        with contextlib.suppress(OSError):
            os.sched_setscheduler(self._process.pid, os.SCHED_FIFO, os.sched_param(_PRIORITY))
        deadline_s = time.monotonic() + _START_S
        while not self._answers():
            if self._process.poll() is not None or time.monotonic() > deadline_s:
                self.__exit__(None, None, None)
                raise NotReadyError(
                    f"The control box did not start: {self._log.read_text(errors='replace')[-800:]}"
                )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        process = self._process
        if process is not None and process.poll() is None:
            process.terminate()
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def tell(self, **what: float) -> dict[str, Any]:
        """Ask for its counts; see `proxy` for what may be told. Raises OSError."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            asking.settimeout(2.0)
            asking.connect((self.host, ASKING_PORT))
            asking.send(json.dumps(what).encode())
            answer: dict[str, Any] = json.loads(asking.recv(65536))
            return answer

    def _answers(self) -> bool:
        try:
            return bool(self.tell())
        except OSError:
            time.sleep(0.05)
            return False
