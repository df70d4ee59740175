"""What a module's server announces before it sends a request to the module.

ROS does not tell who has sent a request, and anybody on the graph may send one. The server
therefore announces each lifecycle transition and each change of parameters over the module's stdin,
a pipe that nobody else holds, by a digest of its content. A feature refuses what was not announced
(`ModuleHost.is_announced`). A foreign node that repeats an announced request before the server's
own arrives has done what the server wanted.

The announcement lies in the pipe before the request is sent. Before it is judged the pipe is read
to its present end, by the thread that judges: no thread has to be given the processor in time for
that, and nothing has to be waited for.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

_MOST = 256
"""Announcements that wait for their request; requests that never arrive are forgotten in order."""


def digest_of(request: object) -> bytes:
    """SHA-256, in hexadecimal, of a request with all that it asks for.

    It is the same in the server and in the module, whatever their interpreters.

    Args:
        request: of a service.
    """
    text = json.dumps(request, default=_contents, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest().encode()


def _contents(value: Any) -> object:
    """Fields of a message, or elements of an array: not its `repr`, which differs between
    distributions of ROS.
    """
    if hasattr(value, "get_fields_and_field_types"):
        return {name: getattr(value, name) for name in value.get_fields_and_field_types()}
    return [str(element) for element in value]


def parameters_request(values: Mapping[str, str | int]) -> SetParameters.Request:
    """The request to set these parameters."""
    parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    return SetParameters.Request(parameters=parameters)


class Announcements:
    """What the server has announced and the module has not been asked for yet; usable from any
    thread.

    Attributes:
        catch_up: feeds what the server has written until now.
    """

    def __init__(self, catch_up: Callable[[], object] = lambda: None) -> None:
        """Args:
        catch_up: see `catch_up` above.
        """
        self.catch_up = catch_up
        self._lock = threading.Lock()
        self._digests: deque[bytes] = deque(maxlen=_MOST)
        self._rest = b""
        self._is_supervised = False

    def feed(self, data: bytes) -> None:
        """Take what was read from stdin.

        Args:
            data: a line for each announcement, empty lines for signs of life; a line may be cut
                anywhere, its rest comes with the next call.
        """
        with self._lock:
            self._is_supervised = True
            *lines, self._rest = (self._rest + data).split(b"\n")
            self._digests.extend(line for line in lines if line)

    def take(self, digest: bytes) -> bool:
        """Whether a request was announced, and is not any more; each announcement counts once.

        To a module without a server, as one is started by hand, everything counts as announced.

        Args:
            digest: of the request.
        """
        # Without the lock: this calls `feed`, on this thread.
        self.catch_up()
        with self._lock:
            if not self._is_supervised:
                return True
            if digest not in self._digests:
                return False
            self._digests.remove(digest)
            return True
