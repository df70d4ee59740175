"""Strict parsing of JSON-RPC messages, so that the sender of an invalid one gets an answer."""

from __future__ import annotations

import json
from typing import Final, Self

from mcp.types import JSONRPCMessage, jsonrpc_message_adapter
from pydantic import ValidationError
from pydantic_core import from_json

__all__ = ["EnvelopeError", "is_urgent"]
"""Names that other distributions may use."""

INVALID_JSON, INVALID_REQUEST = -32700, -32600
"""Error codes. Source: JSON-RPC 2.0, section 5.1."""
URGENT_TOOLS = frozenset({"emergency_stop"})
"""Tools whose calls overtake all waiting messages."""


class EnvelopeError(Exception):
    """An invalid message; `answer` is the response to its sender."""

    BUSY: Final = -32000
    """Error code of this server: too many waiting requests."""

    def __init__(self, code: int, message: str, request_id: object = None) -> None:
        super().__init__(message)
        known = isinstance(request_id, int | str) and not isinstance(request_id, bool)
        self.request_id = request_id if known else None
        self.error = {"code": code, "message": message}

    @classmethod
    def repeated(cls, request_id: int | str) -> Self:
        """Create the error for a request whose id is in use: its cancellation would be
        ambiguous.
        """
        return cls(
            INVALID_REQUEST,
            "A request with this id is still being handled; use another id.",
            request_id,
        )

    @classmethod
    def raise_for_id(cls, raw: object) -> None:
        """Raise the error for a request whose id is neither a string nor an integer; it would be
        taken for a notification.
        """
        if isinstance(raw, dict) and "id" in raw and "method" in raw:
            found = raw["id"]
            if isinstance(found, bool) or not isinstance(found, int | str):
                raise cls(INVALID_REQUEST, "The id of a request must be a text or an integer.")

    @property
    def answer(self) -> str:
        """The JSON-RPC error, without a newline."""
        return json.dumps({"jsonrpc": "2.0", "id": self.request_id, "error": self.error})


def read_message(data: bytes) -> JSONRPCMessage:
    """Parse one JSON-RPC message into the SDK's model.

    Raises:
        EnvelopeError: not UTF-8, not JSON, a batch, or not a request, notification or response with
            a valid id.
    """
    try:
        data.decode("utf-8")  # the parser below would accept some invalid UTF-8 as text
        raw = from_json(data)
    except (ValueError, RecursionError) as error:
        what = "UTF-8" if isinstance(error, UnicodeDecodeError) else "JSON"
        raise EnvelopeError(INVALID_JSON, f"This is no {what}.") from error
    EnvelopeError.raise_for_id(raw)
    try:
        return jsonrpc_message_adapter.validate_python(raw, by_name=False)
    except ValidationError as error:
        found = raw.get("id") if isinstance(raw, dict) else None
        raise EnvelopeError(INVALID_REQUEST, "This is no JSON-RPC request.", found) from error


def is_urgent(method: object, params: object) -> bool:
    """True for a message that must not wait: an emergency stop, or the cancellation of a
    request.
    """
    if method == "notifications/cancelled":
        return True
    return (
        method == "tools/call" and isinstance(params, dict) and params.get("name") in URGENT_TOOLS
    )
