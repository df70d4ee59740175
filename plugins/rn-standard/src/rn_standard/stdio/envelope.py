"""JSON-RPC messages as they come off a wire: read strictly, so that whoever sent something else
gets an answer.
"""

from __future__ import annotations

import json
from typing import Final, Self

from mcp.types import JSONRPCMessage, jsonrpc_message_adapter
from pydantic import ValidationError
from pydantic_core import from_json

INVALID_JSON, INVALID_REQUEST = -32700, -32600
"""Error codes. Source: JSON-RPC 2.0, section 5.1."""
URGENT_TOOLS = frozenset({"emergency_stop"})
"""Calls of these overtake whatever else waits."""


class EnvelopeError(Exception):
    """What came is no message; `answer` is what its sender gets."""

    BUSY: Final = -32000
    """Error code of this server's own: too many requests wait."""

    def __init__(self, code: int, message: str, request_id: object = None) -> None:
        super().__init__(message)
        known = isinstance(request_id, int | str) and not isinstance(request_id, bool)
        self.request_id = request_id if known else None
        self.error = {"code": code, "message": message}

    @classmethod
    def repeated(cls, request_id: int | str) -> Self:
        """For a request whose id is that of another one at work: cancelling it could not tell
        which is meant.
        """
        return cls(
            INVALID_REQUEST,
            "A request with this id is still being handled; use another id.",
            request_id,
        )

    @classmethod
    def raise_for_id(cls, raw: object) -> None:
        """Raise it for a request whose id is no text and no integer: it would pass for a
        notification.
        """
        if isinstance(raw, dict) and "id" in raw and "method" in raw:
            found = raw["id"]
            if isinstance(found, bool) or not isinstance(found, int | str):
                raise cls(INVALID_REQUEST, "The id of a request must be a text or an integer.")

    @property
    def answer(self) -> str:
        """One JSON-RPC error, without a newline."""
        return json.dumps({"jsonrpc": "2.0", "id": self.request_id, "error": self.error})


def read_message(data: bytes) -> JSONRPCMessage:
    """One JSON-RPC message, as the SDK's model.

    Raises:
        EnvelopeError: not UTF-8, not JSON, a batch, or no request, notification or response with a
            valid id.
    """
    try:
        data.decode("utf-8")  # the parser below would let some of what is not UTF-8 pass as text
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
    """Whether a message must not wait: an emergency stop, or a request that is cancelled."""
    if method == "notifications/cancelled":
        return True
    return (
        method == "tools/call" and isinstance(params, dict) and params.get("name") in URGENT_TOOLS
    )
