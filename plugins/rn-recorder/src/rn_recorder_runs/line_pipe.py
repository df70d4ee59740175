"""Lines of JSON from the recorder to its server, each whole or not at all."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from typing import Any

log = logging.getLogger("recorder")
MOST_BYTES = 256_000
"""Bytes kept for a server that does not read; it ends a silent recorder long before."""


class LinePipe:
    """Writes lines to a pipe without blocking. For one thread.

    A pipe takes a part of a line when it is nearly full: the rest precedes the next line.

    Args:
        descriptor: write end of a pipe; set to non-blocking.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._rest = b""
        os.set_blocking(descriptor, False)

    def write(self, value: Mapping[str, object]) -> None:
        """Write one line; one that finds no room is logged as lost."""
        self._flush()
        line = json.dumps(value).encode() + b"\n"
        if len(self._rest) > MOST_BYTES:
            log.error("A line is lost, because the server does not read: %.200r", line)
            return
        self._rest += line
        self._flush()

    def _flush(self) -> None:
        try:
            while self._rest:
                self._rest = self._rest[os.write(self._descriptor, self._rest) :]
        except BlockingIOError:
            pass
        except OSError:  # the server has ended: nobody is left who could be told
            self._rest = b""


def own_stdout() -> int:
    """Return a descriptor of the standard output that nothing else in this process has.

    Whatever is printed from now on goes to standard error: Fast DDS warns on standard output, from
    threads of its own, and plugins print; both would break lines of answers.
    """
    wire = os.dup(1)
    os.dup2(2, 1)
    return wire


def parse_line(line: bytes) -> dict[str, Any] | None:
    """Parse one line of either direction; None if it is not one whole JSON object."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None
