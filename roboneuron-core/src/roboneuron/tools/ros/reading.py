"""Reading of a topic's next messages, with the quality of service of its publishers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from roboneuron.direct_path.fields import load_type
from roboneuron.direct_path.type_hashes import check_type_hash
from roboneuron.errors import ConfigurationError, NotReadyError, StateError
from roboneuron.ros import topics
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint

_POLL_S = 0.02


@dataclass(kw_only=True, slots=True)
class Heard:
    """Received messages.

    Attributes:
        publishers: number of publishers of the topic.
        messages: in the order of arrival, each with its monotonic arrival time.
    """

    publishers: int = 0
    messages: list[tuple[float, object]] = field(default_factory=list)


def read_messages(
    host: Host, exposed: ExposedEndpoint, *, count: int, timeout_s: float, halt: threading.Event
) -> Heard:
    """Subscribe, wait for the latched message or the next `count` messages, and unsubscribe;
    blocks.

    Until the first message, the subscription adapts to the present publishers, because one that has
    just left may still be on the graph.

    Raises:
        ConfigurationError: the topic has another type.
        StateError: `halt` was set.
    """
    deadline_s = time.monotonic() + timeout_s
    heard = Heard()
    complete = threading.Event()
    unsubscribe: Callable[[], None] | None = None
    subscribed: set[tuple[object, object]] = set()

    def take(message: object) -> None:
        if len(heard.messages) < count:
            heard.messages.append((time.monotonic(), message))
        if len(heard.messages) >= count:
            complete.set()

    try:
        while True:
            infos = [] if heard.messages else host.graph.publishers(exposed.topic)
            foreign = [
                info.topic_type for info in infos if info.topic_type != exposed.endpoint.type
            ]
            if foreign:
                raise ConfigurationError(
                    f"Topic {exposed.topic} carries {foreign[0]}, it is exposed as "
                    f"{exposed.endpoint.type}."
                )
            check_type_hash(exposed.topic, exposed.endpoint.type, infos)
            if infos:
                heard.publishers = len(infos)
                offered = {
                    (info.qos_profile.reliability, info.qos_profile.durability) for info in infos
                }
                if offered != subscribed:
                    if unsubscribe is not None:
                        unsubscribe()
                    unsubscribe = host.subscribe(
                        load_type(exposed.endpoint.type),
                        exposed.topic,
                        take,
                        depth=count,
                        latched=True,
                    )
                    subscribed = offered
            remaining_s = deadline_s - time.monotonic()
            if complete.wait(max(0.0, min(_POLL_S, remaining_s))) or remaining_s <= 0:
                return heard
            if halt.is_set():
                raise StateError("The call was cancelled.")
    finally:
        if unsubscribe is not None:
            unsubscribe()


def check_heard(heard: Heard, exposed: ExposedEndpoint, timeout_s: float) -> None:
    """Raise NotReadyError if no message arrived."""
    if heard.messages:
        return
    who = (
        "Nobody publishes"
        if not heard.publishers
        else f"{heard.publishers} publish, but nothing came on"
    )
    raise NotReadyError(
        f"{who} {exposed.topic} ({exposed.endpoint.type}) within {timeout_s:g} s.",
        hint=start_hint(exposed.topic),
    )


_PUBLISHERS = {"ee_pose": "control", topics.JOINT_STATES: "robot"}
"""Modules that publish, by the last part of the topic."""


def start_hint(topic: str) -> str:
    """What to start for messages of a topic under a robot's namespace."""
    kind = _PUBLISHERS.get(topic.rsplit("/", 1)[-1])
    kind = "perception" if "/camera/" in topic else kind
    if kind is None:
        return "Start what publishes it; list_topics, which find_tools has, tells who does."
    return f"Call start_{kind}: {kind} publishes it."


def read_newest(
    host: Host, exposed: ExposedEndpoint, timeout_s: float, halt: threading.Event
) -> tuple[float, object]:
    """Return the latched message or the next one, with its monotonic arrival time; blocks.

    Raises:
        ConfigurationError, StateError: as `read_messages`.
        NotReadyError: no message arrived.
    """
    heard = read_messages(host, exposed, count=1, timeout_s=timeout_s, halt=halt)
    check_heard(heard, exposed, timeout_s)
    return heard.messages[-1]
