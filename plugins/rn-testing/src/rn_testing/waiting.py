"""Bounded waits for conditions in tests: a wait ends as soon as its condition holds."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterable


def holds_within(
    condition: Callable[[], object], timeout_s: float = 20.0, *, poll_s: float = 0.005
) -> bool:
    """Poll `condition` until it is true or `timeout_s` is over; return whether it became true."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(poll_s)
    return True


def wait_until(
    condition: Callable[[], object],
    timeout_s: float = 20.0,
    what: str = "the condition",
    *,
    poll_s: float = 0.01,
) -> float:
    """Wait until `condition` is true; return the elapsed time [s].

    Raises:
        AssertionError: it did not become true within `timeout_s`; the text contains `what`.
    """
    begun_s = time.monotonic()
    if not holds_within(condition, timeout_s, poll_s=poll_s):
        raise AssertionError(f"not within {timeout_s:g} s: {what}")
    return time.monotonic() - begun_s


def wait_for_line(output: Iterable[str] | None, words: str) -> str:
    """Read the output of a process until a line contains `words`; return this line.

    Other lines are passed over, because ROS libraries print warnings there (Fast DDS, of a port
    in use, on the standard output). Not bounded: the test's own timeout applies.

    Args:
        output: `stdout` or `stderr` of a process that was started with `text=True` and a pipe.

    Raises:
        AssertionError: the output ended without it; the text contains the lines.
    """
    lines: list[str] = []
    for line in output or ():
        if words in line:
            return line
        lines.append(line)
    raise AssertionError(f"the output ended without {words!r}: {lines}")


def is_closed(connection: socket.socket, timeout_s: float = 20.0) -> bool:
    """Whether the other end closes it within `timeout_s`; a reset says so too, when the other end
    had something left to read.
    """
    connection.settimeout(timeout_s)
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True
    except TimeoutError:
        return False
