"""Derivation of tools from exposed endpoints: grouping by robot, names, schemas, descriptions,
annotations.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable

from pydantic.json_schema import JsonSchemaValue

from roboneuron.direct_path.derived import Derived
from roboneuron.direct_path.transforms import TYPE
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint
from roboneuron.server.tool import Tool
from roboneuron.tools.ros.action import GoalSending, SendGoal, goal_model
from roboneuron.tools.ros.battery import BATTERY, Battery, battery_of
from roboneuron.tools.ros.detections import FLAT, SPATIAL, Detections, GetDetections, detections_of
from roboneuron.tools.ros.exposed_types import action_of, message_of, service_of
from roboneuron.tools.ros.lookup import FoundTransform, LookingUp, Lookup
from roboneuron.tools.ros.naming import tool_name
from roboneuron.tools.ros.newest import GetNewest, GettingNewest
from roboneuron.tools.ros.publish import Delivery, Publish, Publishing
from roboneuron.tools.ros.read import Read, Reading, messages_model
from roboneuron.tools.ros.schemas import hull, message_schema
from roboneuron.tools.ros.sequence import PublishSequence, Sequencing
from roboneuron.tools.ros.service import Calling, CallService, served_model
from roboneuron.tools.ros.targets import Targets

_READ_AS = {TYPE: "lookup", BATTERY: "battery", FLAT: "detections", SPATIAL: "detections"}
"""Topic types with an additional tool in plain units, and its use."""
_SENT = "Fails without a subscriber."


def derive_tools(
    endpoints: Iterable[ExposedEndpoint], host: Host, taken: Collection[str]
) -> list[Tool]:
    """Create the tools of the endpoints, in their order; endpoints of the same label, kind and type
    share one tool for all robots.

    Args:
        endpoints: the exposed endpoints.
        host: reads and sends their messages.
        taken: names of other tools.
    """
    groups: dict[tuple[str, str, str], list[ExposedEndpoint]] = {}
    for exposed in endpoints:
        groups.setdefault((exposed.endpoint.kind, exposed.label, exposed.endpoint.type), []).append(
            exposed
        )
    names = set(taken)
    tools: list[Tool] = []
    for (kind, label, _), members in groups.items():
        targets = Targets(members)
        uses = ["publish", "sequence"] if kind == "publish" else [kind]
        if kind == "read" and targets.first.endpoint.type in _READ_AS:
            uses.append(_READ_AS[targets.first.endpoint.type])
        for use in uses:
            name = tool_name(use, label, targets.first.robot, names)
            names.add(name)
            tools.append(_make(use, name, label.replace("_", " "), targets, host))
    return tools


_SHOWN_BY_LOOK = ("sensor_msgs/msg/Image", "geometry_msgs/msg/PoseStamped")
"""Types of what look tells in better form: pictures, and the pose of the hand."""


def _make(use: str, name: str, noun: str, targets: Targets, host: Host) -> Tool:
    makers: dict[str, Callable[[str, str, Targets, Host], Tool]] = {
        "publish": _publish,
        "sequence": _sequence,
        "read": _read,
        "service": _service,
        "action": _action,
        "lookup": _lookup,
        "battery": _battery,
        "detections": _detections,
    }
    return makers[use](name, noun, targets, host)


def _publish(name: str, noun: str, targets: Targets, host: Host) -> Tool[Publish]:
    gate = host.gate
    message = message_schema(
        message_of(targets.first), hull([e.endpoint for e in targets.endpoints])
    )
    properties = {**targets.schema(), "message": message}
    lasts = ""
    if targets.lasting:
        properties["duration_s"] = {"maximum": gate.max_duration_s}
        stops = any(e.endpoint.stop_message for e in targets.endpoints)
        lasts = "Lasts for duration_s" + (
            ", then the stop message is sent; returns after that. " if stops else ". "
        )
    elif targets.trajectory:
        lasts = "Returns when its time is over; if cancelled, the joints hold. "
    properties["timeout_s"] = {}
    return Tool(
        name=name,
        title=f"Publish {noun}",
        description=f"{targets.describe()} {lasts}{_SENT}",
        arguments=Derived(
            model=Publish,
            properties=properties,
            required=_required(targets, "message", message_of(targets.first).fields),
        ),
        result=Delivery,
        handler=Publishing(gate, targets, name),
        open_world=True,
        simulated_by=frozenset({"twin", "limits"} if targets.trajectory else {"limits"}),
    )


def _sequence(name: str, noun: str, targets: Targets, host: Host) -> Tool[PublishSequence]:
    gate = host.gate
    needed = [
        *(["message"] if message_of(targets.first).fields else []),
        *([] if targets.trajectory else ["duration_s"]),
    ]
    step: JsonSchemaValue = {
        "type": "object",
        "properties": {
            "message": {
                "type": "object",
                "description": f"As `message` of {name.removesuffix('_sequence')}.",
            },
            "duration_s": {
                "type": "number",
                "exclusiveMinimum": 0,
                "maximum": gate.max_duration_s,
                "description": "Of this step [s].",
            },
        },
        "additionalProperties": False,
        "required": needed,
    }
    if not needed:
        del step["required"]
    steps: JsonSchemaValue = {
        "items": step,
        "description": "One after the other.",
    }
    stops = any(e.endpoint.stop_message for e in targets.endpoints)
    end = (
        "It always ends with the stop message, also when it is cancelled or fails. "
        if stops
        else ""
    )
    return Tool(
        name=name,
        title=f"Publish {noun}, step by step",
        description=(
            f"As {name.removesuffix('_sequence')}, step by step, at most "
            f"{gate.max_duration_s:g} s; cancelling the call ends it at once. {end}".rstrip()
        ),
        arguments=Derived(
            model=PublishSequence,
            properties={
                **targets.schema(),
                "steps": steps,
                "times": {},
                "timeout_s": {},
            },
            required=[*targets.arguments, "steps"],
        ),
        result=Delivery,
        handler=Sequencing(gate, targets, name),
        open_world=True,
        simulated_by=frozenset({"limits"}),
        seldom=True,
    )


def _read(name: str, noun: str, targets: Targets, host: Host) -> Tool[Read]:
    return Tool(
        name=name,
        title=f"Read {noun}",
        description=targets.describe(),
        arguments=Derived(
            model=Read,
            properties={**targets.schema(), "count": {}, "timeout_s": {}},
            required=targets.arguments,
        ),
        result=messages_model(targets),
        handler=Reading(host, targets, name),
        read_only=True,
        seldom=targets.first.endpoint.type in _SHOWN_BY_LOOK,
        idempotent=True,
        open_world=True,
    )


def _lookup(name: str, noun: str, targets: Targets, host: Host) -> Tool[Lookup]:
    properties: JsonSchemaValue = {"target": {}, "source": {}, "max_age_s": {}, "timeout_s": {}}
    return Tool(
        name=name,
        title=f"Look up {noun}",
        description=f"{targets.describe()} Where the source frame is in the target frame now: its "
        "pose, by the newest transforms.",
        arguments=Derived(
            model=Lookup,
            properties={**targets.schema(), **properties},
            required=[*targets.arguments, "target", "source"],
        ),
        result=FoundTransform,
        handler=LookingUp(host, targets, name),
        read_only=True,
        idempotent=True,
        open_world=True,
    )


def _battery(name: str, noun: str, targets: Targets, host: Host) -> Tool[GetNewest]:
    return Tool(
        name=name,
        title=f"Get {noun}",
        description=f"{targets.describe()} The charge, 0 .. 1, and state of the battery, in plain "
        "units; null is what it does not measure.",
        arguments=Derived(
            model=GetNewest,
            properties={**targets.schema(), "timeout_s": {}},
            required=targets.arguments,
        ),
        result=Battery,
        handler=GettingNewest(host, targets, name, battery_of),
        read_only=True,
        idempotent=True,
        open_world=True,
    )


def _detections(name: str, noun: str, targets: Targets, host: Host) -> Tool[GetDetections]:
    properties: JsonSchemaValue = {"class_id": {}, "min_score": {}, "entries": {}}
    return Tool(
        name=name,
        title=f"Get {noun}",
        description=f"{targets.describe()} What the detector sees now: class, score, box, frame "
        "and age, the surest first.",
        arguments=Derived(
            model=GetDetections,
            properties={**targets.schema(), **properties, "timeout_s": {}},
            required=targets.arguments,
        ),
        result=Detections,
        handler=GettingNewest(host, targets, name, detections_of),
        read_only=True,
        idempotent=True,
        open_world=True,
    )


def _service(name: str, noun: str, targets: Targets, host: Host) -> Tool[CallService]:
    interface = service_of(targets.first)
    request = message_schema(interface.request, hull([e.endpoint for e in targets.endpoints]))
    return Tool(
        name=name,
        title=f"Call {noun}",
        description=f"{targets.describe()} Calls the service and returns its response. A cancelled "
        "call is not recalled: the service goes on.",
        arguments=Derived(
            model=CallService,
            properties={**targets.schema(), "request": request, "timeout_s": {}},
            required=_required(targets, "request", interface.request.fields),
        ),
        result=served_model(targets),
        handler=Calling(host.gate, targets, name),
        open_world=True,
        simulated_by=frozenset({"limits"}),
    )


def _action(name: str, noun: str, targets: Targets, host: Host) -> Tool[SendGoal]:
    gate = host.gate
    interface = action_of(targets.first)
    sending = GoalSending(gate, targets, name)
    properties = {
        **targets.schema(),
        "goal": message_schema(interface.goal, hull([e.endpoint for e in targets.endpoints])),
        "timeout_s": {"maximum": gate.max_duration_s, "default": sending.timeout_s},
        "server_timeout_s": {},
    }
    return Tool(
        name=name,
        title=f"Send a goal: {noun}",
        description=(
            f"{targets.describe()} Sends the goal, reports feedback as progress and returns the "
            "result; cancelling the "
            "call, its timeout or emergency_stop cancels the goal. A goal that does not succeed "
            "is an error."
        ),
        arguments=Derived(
            model=SendGoal,
            properties=properties,
            required=_required(targets, "goal", interface.goal.fields),
        ),
        result=goal_model(targets),
        handler=sending,
        simulated_by=frozenset({"limits"}),
        open_world=True,
    )


def _required(targets: Targets, name: str, fields: Collection[object]) -> list[str]:
    return [*targets.arguments, *([name] if fields else [])]
