"""The driver's side of the process that stops the wheels if the driver cannot."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from fcntl import ioctl
from termios import FIONREAD

from rn_robot_lerobot import wheel_guard_process
from rn_robot_lerobot.wheel_guard_process import END, ROLLING, STANDING
from roboneuron import NotReadyError

_BEAT_S = 0.05
_HUNG_S = 2.0
"""A longer cycle of the bus counts as hung; with a silent bus a cycle takes up to 0.4 s."""
_UNREAD = 20
"""Number of unread heartbeats, one second's worth, at which the guard counts as frozen."""
_START_S, _LEAVE_S, _POLL_S = 5.0, 2.0, 0.01


class WheelGuard:
    """A process that writes packets to a serial port when this process dies, or is frozen while the
    wheels roll.

    Heartbeats come from a separate thread, so that a slow bus does not look like a frozen driver.
    """

    def __init__(self, port: str, packets: Sequence[bytes]) -> None:
        """Args:
        port: path of the device, which is opened a second time.
        packets: packets that stop the wheels, in this order.
        """
        self._port, self._packets = port, packets
        self._process: subprocess.Popen[bytes] | None = None
        self._beat, self._noted_s = STANDING, 0.0
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="wheel-guard", daemon=True)

    def start(self) -> None:
        """Return when the process is ready. Call it once.

        Raises:
            NotReadyError: it does not start.
        """
        program = [sys.executable, "-I", "-S", wheel_guard_process.__file__]
        words = [packet.hex() for packet in self._packets]
        try:
            port = os.open(self._port, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
            try:
                self._process = subprocess.Popen(
                    [*program, *words],
                    stdin=subprocess.PIPE,
                    stdout=port,
                    bufsize=0,
                    # because a kill of the driver may hit its process group
                    start_new_session=True,
                )
            finally:
                os.close(port)
        except OSError as error:
            raise NotReadyError(f"The guard of the wheels does not start: {error}.") from error
        os.set_blocking(self._pipe(), False)
        self._write(STANDING)
        end_s = time.monotonic() + _START_S
        while self._unread():
            if self._process.poll() is not None or time.monotonic() > end_s:
                raise NotReadyError("The guard of the wheels does not start; the log says why.")
            time.sleep(_POLL_S)
        self._noted_s = time.monotonic()
        self._thread.start()

    def note(self, *, is_rolling: bool) -> None:
        """Report a completed cycle of the bus, or that the wheels are about to get their first
        speed.
        """
        beat = ROLLING if is_rolling else STANDING
        self._noted_s = time.monotonic()
        if beat != self._beat:
            self._beat = beat
            self._write(beat)

    def fault(self) -> str:
        """Reason why nothing would stop the wheels, or an empty text."""
        process = self._process
        if process is None or process.poll() is not None:
            return "the guard of the wheels has ended; restart the robot"
        if self._unread() > _UNREAD:
            return "the guard of the wheels does not answer; restart the robot"
        return ""

    def close(self, *, wheels_stand: bool) -> None:
        """End the process, which first stops the wheels unless they stand."""
        self._ending.set()
        process = self._process
        if process is None or process.stdin is None:
            return
        if self._thread.ident is not None:
            self._thread.join()
        if wheels_stand:
            self._write(END)
        process.stdin.close()
        try:
            process.wait(_LEAVE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _run(self) -> None:
        while not self._ending.wait(_BEAT_S):
            if time.monotonic() - self._noted_s < _HUNG_S:
                self._write(self._beat)

    def _pipe(self) -> int:
        assert self._process is not None
        assert self._process.stdin is not None
        return self._process.stdin.fileno()

    def _write(self, beat: bytes) -> None:
        # a guard that has ended or is frozen is a fault, which every cycle of the bus checks
        with suppress(BrokenPipeError, BlockingIOError):
            os.write(self._pipe(), beat)

    def _unread(self) -> int:
        """Number of unread heartbeats in the pipe."""
        return int.from_bytes(ioctl(self._pipe(), FIONREAD, bytes(4)), sys.byteorder)
