"""Tool read_<name>: the next messages of a topic, decoded for agents; images are sent as images."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping, Sequence

from pydantic import Field

from roboneuron.direct_path.derived import Derived
from roboneuron.errors import InvalidInputError
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest
from roboneuron.server.tool import CallContext, Picture, Reply, Result
from roboneuron.tools.ros.calls import RobotCall, Value
from roboneuron.tools.ros.exposed_types import message_of
from roboneuron.tools.ros.interfaces.description import Plain
from roboneuron.tools.ros.reading import check_heard, read_messages
from roboneuron.tools.ros.schemas import decoded_schema
from roboneuron.tools.ros.targets import Targets

_PICTURES = 4
_MOST_TEXT = 30_000


class Read(RobotCall):
    """Arguments of a read tool."""

    count: int = Field(default=1, ge=1, le=100, description="Messages to wait for.")
    timeout_s: float = Field(default=5.0, gt=0, le=60, description="[s]")


class Messages(Result):
    """Received messages."""

    robot: str
    topic: str
    type: str
    messages: list[Value] = Field(description="oldest first")
    complete: bool = Field(description="the requested number arrived")
    publishers: int = Field(description="number of publishers")
    age_s: float = Field(description="since the last one arrived")
    note: str


def messages_model(targets: Targets) -> Derived[Messages]:
    """Return the result model, with the schema of the decoded messages."""
    own: dict[str, dict[str, object]] = {name: {} for name in Messages.model_fields}
    return Derived(
        model=Messages,
        properties=own | {"messages": {"items": decoded_schema(message_of(targets.first))}},
        required=list(own),
    )


class Reading:
    """The handler of one read tool."""

    def __init__(self, host: Host, targets: Targets, tool: str) -> None:
        self._host = host
        self._targets = targets
        self._tool = tool

    async def __call__(self, arguments: Read, context: CallContext) -> Reply:
        """Raises InvalidInputError, RefusedError, NotReadyError, ConfigurationError."""
        exposed = self._targets.of(arguments.robot)
        self._host.gate.check(GateRequest.of(context, self._tool, exposed, (), arguments.given()))
        halt = threading.Event()
        return await context.run(
            lambda _: self._read(exposed, arguments.count, arguments.timeout_s, halt),
            on_cancel=halt.set,
        )

    def _read(
        self, exposed: ExposedEndpoint, count: int, timeout_s: float, halt: threading.Event
    ) -> Reply:
        part = message_of(exposed)
        got = read_messages(self._host, exposed, count=count, timeout_s=timeout_s, halt=halt)
        check_heard(got, exposed, timeout_s)
        age_s = time.monotonic() - got.messages[-1][0]
        messages = [message for _, message in got.messages]
        pictures, note = _pictures(exposed, messages[-_PICTURES:])
        shown = newest([part.decode(message) for message in messages])
        if len(shown) < len(messages):
            cut = (
                f"{len(messages) - len(shown)} older messages are left out: the answer would be "
                "too long"
            )
            note = f"{note}; {cut}" if note else cut
        told = Messages(
            robot=exposed.robot,
            topic=exposed.topic,
            type=exposed.endpoint.type,
            messages=shown,
            complete=len(messages) == count,
            publishers=got.publishers,
            age_s=round(age_s, 4),
            note=note,
        )
        return Reply(result=told, pictures=pictures)


def newest(messages: Sequence[Mapping[str, Plain]]) -> list[dict[str, object]]:
    """Return the last messages, at least one, within the maximum length of an answer."""
    kept: list[dict[str, object]] = []
    room = _MOST_TEXT
    for message in reversed(messages):
        room -= len(json.dumps(message))
        if kept and room < 0:
            break
        kept.append(dict(message))
    return kept[::-1]


def _pictures(exposed: ExposedEndpoint, messages: list[object]) -> tuple[tuple[Picture, ...], str]:
    """Pictures of the newest messages; the note names images that cannot be shown."""
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
