"""Messages of a pairing over TCP: JSON objects with a length prefix."""

from __future__ import annotations

import json
import socket
import struct
import time

from rn_link_pairing.pake import PairingError
from roboneuron import ForeignDataError, foreign

MOST_BYTES = 16_384
_LENGTH = struct.Struct(">I")


class Wire:
    """One connection; every message must be complete before `deadline_s` (monotonic)."""

    def __init__(self, connection: socket.socket, deadline_s: float) -> None:
        self._connection = connection
        self._deadline_s = deadline_s

    def begin(self, deadline_s: float) -> None:
        """Set another deadline (monotonic)."""
        self._deadline_s = deadline_s

    def send(self, **fields: object) -> None:
        """Send one message; raises OSError."""
        content = json.dumps(fields).encode()
        self._connection.settimeout(self._left_s())
        self._connection.sendall(_LENGTH.pack(len(content)) + content)

    def receive(self, *names: str) -> list[str]:
        """Return these text fields of the next message.

        Raises:
            PairingError: it is malformed.
            OSError: it did not arrive in time.
        """
        (length,) = _LENGTH.unpack(self._read(_LENGTH.size))
        if length > MOST_BYTES:
            raise PairingError("the other side does not use this protocol")
        return parse(self._read(length), *names)

    def _read(self, size: int) -> bytes:
        content = b""
        while len(content) < size:
            self._connection.settimeout(self._left_s())
            part = self._connection.recv(size - len(content))
            if not part:
                raise PairingError("the other side has closed the connection")
            content += part
        return content

    def _left_s(self) -> float:
        left_s = self._deadline_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("the other side did not answer in time")
        return left_s


def parse(content: bytes, *names: str) -> list[str]:
    """Return text fields of a JSON object; raises PairingError."""
    try:
        fields = foreign.decode_json(content, "a message", most_bytes=MOST_BYTES)
        return [foreign.text(foreign.field(fields, name), name, MOST_BYTES) for name in names]
    except ForeignDataError as error:
        raise PairingError("the other side does not use this protocol") from error


def to_bytes(text: str) -> bytes:
    """Bytes from hexadecimal digits; raises PairingError."""
    try:
        return foreign.octets(text, "a value")
    except ForeignDataError as error:
        raise PairingError("the other side does not use this protocol") from error
