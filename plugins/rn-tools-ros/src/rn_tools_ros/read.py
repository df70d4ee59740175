"""read_<name>: the next messages of a topic, decoded for agents; images come as images."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any

from rn_tools_ros.arguments import Number, Schema, check_names, object_schema
from rn_tools_ros.exposed_types import message_of
from rn_tools_ros.schemas import decoded_schema
from rn_tools_ros.targets import Targets
from roboneuron.errors import InvalidInputError, NotReadyError
from roboneuron.server.motion.exposed import Exposed, gate_request
from roboneuron.server.motion.gate import MotionGate
from roboneuron.server.tool import Answer, CallContext, Picture

COUNT = Number(text="How many messages to wait for.", low=1, high=100, default=1, integer=True)
TIMEOUT = Number(text="How long to wait, in seconds.", low=0.0, high=60.0, default=5.0, above=True)
_PICTURES = 4


def reading_schema(targets: Targets) -> Schema:
    """The output schema."""
    message = decoded_schema(message_of(targets.first))
    properties: dict[str, Schema] = {
        "robot": {"type": "string"},
        "topic": {"type": "string"},
        "type": {"type": "string"},
        "messages": {"type": "array", "items": message, "description": "oldest first"},
        "complete": {"type": "boolean", "description": "as many came as were asked for"},
        "publishers": {"type": "integer", "description": "how many publish the topic"},
        "age_s": {"type": "number", "description": "since the last one arrived"},
        "note": {"type": "string"},
    }
    return object_schema(properties, list(properties))


class Reading:
    """The handler of one read tool."""

    def __init__(self, gate: MotionGate, targets: Targets, tool: str) -> None:
        self._gate = gate
        self._targets = targets
        self._tool = tool
        self._names = [*targets.arguments, "count", "timeout_s"]

    async def __call__(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Raises InvalidInputError, RefusedError, NotReadyError, ConfigurationError."""
        check_names(arguments, self._names)
        exposed = self._targets.take(arguments)
        count, timeout_s = int(COUNT.take("count", arguments)), TIMEOUT.take("timeout_s", arguments)
        self._gate.check(gate_request(context, self._tool, exposed, (), arguments))
        halt = threading.Event()
        return await context.run(lambda _: self._read(exposed, count, timeout_s, halt), on_cancel=halt.set)

    def _read(self, exposed: Exposed, count: int, timeout_s: float, halt: threading.Event) -> Answer:
        part = message_of(exposed)
        got = self._gate.read(exposed, count=count, timeout_s=timeout_s, halt=halt)
        if not got.messages:
            who = "Nobody publishes" if not got.publishers else f"{got.publishers} publish, but nothing came on"
            raise NotReadyError(
                f"{who} {exposed.topic} ({exposed.endpoint.type}) within {timeout_s:g} s.",
                hint="Start what publishes it, or look at list_topics.",
            )
        age_s = time.monotonic() - got.messages[-1][0]
        messages = [message for _, message in got.messages]
        pictures, note = _pictures(exposed, messages[-_PICTURES:])
        return Answer(
            structured={
                "robot": exposed.robot,
                "topic": exposed.topic,
                "type": exposed.endpoint.type,
                "messages": [part.decode(message) for message in messages],
                "complete": len(messages) == count,
                "publishers": got.publishers,
                "age_s": round(age_s, 4),
                "note": note,
            },
            pictures=pictures,
        )


def _pictures(exposed: Exposed, messages: list[Any]) -> tuple[tuple[Picture, ...], str]:
    """Pictures of the newest messages; what cannot be shown is said in the note."""
    found: list[Picture] = []
    notes: list[str] = []
    for message in messages:
        try:
            made = message_of(exposed).pictures(message)
        except InvalidInputError as error:
            notes.append(str(error))
            continue
        found += [Picture(data=picture.data, mime_type=picture.mime_type) for picture in made]
        notes += [picture.note for picture in made if picture.note]
    return tuple(found[-_PICTURES:]), "; ".join(dict.fromkeys(notes))
