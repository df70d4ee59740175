"""A process of our own that answers requests: what crashes, hangs or takes too long in native code
ends that process, and not the server.

`python -m roboneuron.answering_process FD` makes an object and calls its methods for its
parent until that closes the socket, or ends.
"""

from __future__ import annotations

import os
import pickle
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import cast

from roboneuron.errors import NotReadyError, RoboNeuronError
from roboneuron.hang_watch import VARIABLE

__all__ = ["AnsweringProcess"]
"""Names that other distributions may use."""

COMMAND = (sys.executable, "-P", "-m", "roboneuron.hang_watch", "roboneuron.answering_process")
"""Command line, to which the descriptor of its socket is added."""
MOST_BYTES = 64 << 20
"""Largest answer [bytes]: a picture of 4096 x 4096 pixels has 48 MiB."""
_HEAD = struct.Struct("!Q")
_NICE = 5
_LEAST_S = 0.05
_LOOK_S, _FROZEN_S = 0.1, 0.3
"""Period of checking that the process is not stopped, and for how long it may be, as a module."""
_END_S = 2.0


class AnsweringProcess:
    """An object in another process, which runs at a lower priority than control; used from one
    thread at a time.

    Args:
        subject: what it is in messages, such as "The twin of the cell".
        target: "module:attribute" of the object's class, called without arguments there.
        hang_s: longest time in which no Python code of it runs, such as while it loads a native
            library [s]; None for the usual one.
    """

    def __init__(self, subject: str, target: str, *, hang_s: float | None = None) -> None:
        self._subject = subject
        own, other = socket.socketpair()
        self._socket = own
        environment = dict(os.environ)
        if hang_s is not None:
            environment[VARIABLE] = f"{hang_s:g}"
        with other:
            self._process = subprocess.Popen(
                [*COMMAND, str(other.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # the server's is the wire of MCP
                pass_fds=(other.fileno(),),
                env=environment,
            )
        self._to_greet: tuple[list[str], str] | None = (sys.path, target)

    @property
    def is_alive(self) -> bool:
        """Whether it can be asked."""
        return self._process.poll() is None

    def ask(self, name: str, *arguments: object, end_s: float) -> object:
        """The answer of a method.

        Args:
            name: of the method.
            arguments: of the method, which can be pickled.
            end_s: monotonic time after which the process is killed instead of being waited for [s].

        Raises:
            NotReadyError: it has ended, is frozen, is late, or failed with another error.
            RoboNeuronError: the method raised it.
        """
        end_s = max(time.monotonic() + _LEAST_S, end_s)
        self.begin(name, *arguments, end_s=end_s)
        if not self.has_answer(end_s):
            raise self._late()
        return self.answer(end_s)

    def begin(self, name: str, *arguments: object, end_s: float) -> None:
        """Ask without waiting for the answer. Raises NotReadyError: it has ended, or does not read
        what it is sent by `end_s`; it is killed then.
        """
        messages: list[object] = [(name, arguments)]
        if self._to_greet is not None:
            messages.insert(0, self._to_greet)
            self._to_greet = None
        self._socket.settimeout(max(_LEAST_S, end_s - time.monotonic()))
        try:
            for message in messages:
                _send(self._socket, message)
        except TimeoutError:
            raise self._late() from None
        except OSError as error:
            raise self._gone(error) from error

    def has_answer(self, end_s: float) -> bool:
        """True if the answer comes, or the process ends, before `end_s` (monotonic time).

        Raises:
            NotReadyError: the process is stopped; it is killed.
        """
        arrival, stops = select.poll(), 0
        arrival.register(self._socket, select.POLLIN)
        while not arrival.poll(1e3 * min(_LOOK_S, max(0.0, end_s - time.monotonic()))):
            stops = stops + 1 if self._is_stopped() else 0
            if stops * _LOOK_S > _FROZEN_S:
                self.end()
                raise NotReadyError(
                    f"{self._subject} is frozen (SIGSTOP or a debugger).", hint="Call again."
                )
            if time.monotonic() > end_s:
                return False
        return True

    def answer(self, end_s: float) -> object:
        """The answer that has come. Raises as `ask`."""
        try:
            answer, failure = _receive(self._socket, end_s)
        except TimeoutError:
            raise self._late() from None
        except (OSError, EOFError) as error:
            raise self._gone(error) from error
        if isinstance(failure, RoboNeuronError):
            raise failure
        if failure:
            raise NotReadyError(f"{self._subject} failed: {failure}")
        return answer

    def end(self) -> None:
        """End the process; may be called twice."""
        self._socket.close()
        self._process.kill()  # also if it is stopped
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)

    def _late(self) -> NotReadyError:
        self.end()  # what it still does would be the answer to the next request
        return NotReadyError(f"{self._subject} did not answer in time.")

    def _gone(self, error: Exception) -> NotReadyError:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_LOOK_S)
        status = self._process.poll()
        told = repr(error)
        if status is not None:
            told = signal.Signals(-status).name if status < 0 else f"status {status}"
        return NotReadyError(f"{self._subject} has ended: {told}.")

    def _is_stopped(self) -> bool:
        """True if the process is stopped; it stays one to wait for."""
        with suppress(ChildProcessError):
            options = os.WSTOPPED | os.WNOHANG | os.WNOWAIT
            return os.waitid(os.P_PID, self._process.pid, options) is not None
        return False


def _send(own: socket.socket, message: object) -> None:
    data = pickle.dumps(message)
    own.sendall(_HEAD.pack(len(data)))
    own.sendall(data)


def _receive(own: socket.socket, end_s: float | None = None) -> tuple[object, object]:
    """The next message, a pair. Raises TimeoutError, OSError, EOFError."""
    (size,) = _HEAD.unpack(_read(own, _HEAD.size, end_s))
    if size > MOST_BYTES:
        raise EOFError(f"a message of {size} bytes")
    first, second = pickle.loads(_read(own, size, end_s))
    return first, second


def _read(own: socket.socket, size: int, end_s: float | None) -> bytearray:
    data = bytearray(size)
    rest = memoryview(data)
    while rest:
        if end_s is not None:
            own.settimeout(max(_LEAST_S, end_s - time.monotonic()))
        count = own.recv_into(rest)
        if not count:
            raise EOFError
        rest = rest[count:]
    return data


def _serve(own: socket.socket) -> None:
    """Answer until the other end is closed; a failure is an answer too."""
    from roboneuron.plugins.loading import load_attribute

    path, target = _receive(own)
    sys.path[:] = cast("list[str]", path)
    served: object = None
    while True:
        name, arguments = _receive(own)
        answer: object = None
        failure: object = ""
        try:
            if served is None:
                kind = load_attribute(str(target), "class of a process")
                served = cast("Callable[[], object]", kind)()
            answer = getattr(served, str(name))(*cast("tuple[object, ...]", arguments))
        except RoboNeuronError as error:
            failure = error
        except Exception as error:  # the border to a plugin's own code
            failure = f"{type(error).__name__}: {error}"
        _send(own, (answer, failure))


def _end_with_parent() -> None:
    """End this process when its parent ends, whatever its threads do.

    The socket alone is not enough: it is read between requests only. It ends a process whose parent
    has died before this.
    """
    held = select.poll()
    held.register(os.pidfd_open(os.getppid()), select.POLLIN)
    held.poll()
    os._exit(3)


def main(words: list[str]) -> None:
    """Serve the parent.

    Args:
        words: descriptor of the socket.
    """
    os.nice(_NICE)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(OSError, EOFError), socket.socket(fileno=int(words[0])) as own:
        _serve(own)


if __name__ == "__main__":
    main(sys.argv[1:])
