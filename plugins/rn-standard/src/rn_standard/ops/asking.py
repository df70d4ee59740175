"""Questions to the user of a client, by MCP elicitation.

Up to revision 2025-11-25 the server sends the question while the call waits. From 2026-07-28 on the
call is answered with the question, and the client repeats it with the user's answer.
"""

from __future__ import annotations

import secrets
from collections import deque

import anyio
from mcp import types
from mcp.server.context import ServerRequestContext
from mcp.shared.exceptions import MCPError
from mcp_types.version import is_version_at_least

_ASKED_IN_RESULT = "2026-07-28"
_KEY, _FIELD, _TYPED = "confirm", "confirmed", "typed"
_SCHEMA: dict[str, object] = {
    "type": "object",
    "properties": {
        _FIELD: {
            "type": "boolean",
            "title": "Yes",
            "description": "Tick this to agree.",
            "default": False,
        }
    },
    "required": [_FIELD],
}
_ANSWER_S = 300.0
_MOST = 64


class Questions:
    """Asks questions and stores them: an answer to an unknown question is ignored."""

    def __init__(self) -> None:
        self._open: deque[tuple[str, str]] = deque(maxlen=_MOST)

    async def ask(
        self,
        request: ServerRequestContext[object, object],
        params: types.CallToolRequestParams,
        text: str,
        what: str = "",
    ) -> str | types.InputRequiredResult | None:
        """See `roboneuron.server.surface.Ask`; also returns None if no answer came in time."""
        declared = request.session.client_capabilities
        elicitation = declared.elicitation if declared is not None else None
        if elicitation is None or (elicitation.form is None and elicitation.url is not None):
            return None
        if is_version_at_least(request.protocol_version, _ASKED_IN_RESULT):
            return self._answer(params, text, what)
        with anyio.move_on_after(_ANSWER_S):
            try:
                return _told(
                    await request.session.elicit_form(text, _schema(what), request.request_id), what
                )
            except MCPError:  # for example no channel back to the client
                return None
        return None

    def _answer(
        self, params: types.CallToolRequestParams, text: str, what: str
    ) -> str | types.InputRequiredResult:
        asked = (params.request_state or "", text)
        if asked in self._open:
            self._open.remove(asked)
            return _told((params.input_responses or {}).get(_KEY), what)
        ticket = secrets.token_urlsafe(16)
        self._open.append((ticket, text))
        form = types.ElicitRequestFormParams(message=text, requested_schema=_schema(what))
        question = types.ElicitRequest(params=form)
        return types.InputRequiredResult(input_requests={_KEY: question}, request_state=ticket)


def _schema(what: str) -> dict[str, object]:
    """Schema of a checkbox, or of a text to be typed."""
    if not what:
        return _SCHEMA
    return {
        "type": "object",
        "properties": {_TYPED: {"type": "string", "title": what}},
        "required": [_TYPED],
    }


def _told(answer: object, what: str) -> str:
    """Return the typed text, or "yes"; empty without agreement."""
    if not isinstance(answer, types.ElicitResult) or answer.action != "accept":
        return ""
    content = answer.content or {}
    if what:
        return str(content.get(_TYPED, ""))
    return "yes" if content.get(_FIELD) is True else ""
