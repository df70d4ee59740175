"""From exposed endpoints to tools: grouping by robot, names, schemas, descriptions, annotations."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from rn_tools_ros import read, service
from rn_tools_ros.action import SERVER, GoalSending, goal_schema
from rn_tools_ros.arguments import Schema, boolean, object_schema
from rn_tools_ros.calls import SUBSCRIBER_TIMEOUT
from rn_tools_ros.exposed_types import action_of, message_of, service_of
from rn_tools_ros.naming import tool_name
from rn_tools_ros.publish import Delivery, Publishing, duration_argument
from rn_tools_ros.schemas import hull, message_schema
from rn_tools_ros.sequence import MAX_STEPS, TIMES, Sequencing
from rn_tools_ros.targets import Targets
from roboneuron.server.motion.exposed import Exposed
from roboneuron.server.motion.gate import MotionGate
from roboneuron.server.schema import output_schema
from roboneuron.server.tool import DerivedTool

DRY_RUN = boolean("Only answer what would happen; nothing is sent.")
_SENT = "Fails when nobody subscribes."


def derive_tools(endpoints: Iterable[Exposed], gate: MotionGate, taken: Collection[str]) -> list[DerivedTool]:
    """The tools of the endpoints, in their order; those of one label, kind and type are one tool for all robots.

    Args:
        endpoints: what is exposed.
        gate: what they send through.
        taken: names that other tools have.
    """
    groups: dict[tuple[str, str, str], list[Exposed]] = {}
    for exposed in endpoints:
        groups.setdefault((exposed.endpoint.kind, exposed.label, exposed.endpoint.type), []).append(exposed)
    names = set(taken)
    tools: list[DerivedTool] = []
    delivery = output_schema(Delivery)
    for (kind, label, _), members in groups.items():
        targets = Targets(members)
        uses = ["publish", "sequence"] if kind == "publish" else [kind]
        for use in uses:
            name = tool_name(use, label, targets.first.robot, names)
            names.add(name)
            tools.append(_make(use, name, label.replace("_", " "), targets, gate, delivery))
    return tools


def _make(use: str, name: str, noun: str, targets: Targets, gate: MotionGate, delivery: Schema) -> DerivedTool:
    if use == "publish":
        return _publish(name, noun, targets, gate, delivery)
    if use == "sequence":
        return _sequence(name, noun, targets, gate, delivery)
    if use == "read":
        return _read(name, noun, targets, gate)
    if use == "service":
        return _service(name, noun, targets, gate)
    return _action(name, noun, targets, gate)


def _publish(name: str, noun: str, targets: Targets, gate: MotionGate, delivery: Schema) -> DerivedTool:
    message = message_schema(message_of(targets.first), hull([e.endpoint for e in targets.endpoints]))
    properties = {**targets.schema(), "message": message}
    lasts = ""
    if targets.lasting:
        properties["duration_s"] = duration_argument(gate).schema()
        stops = any(e.endpoint.stop_message for e in targets.endpoints)
        lasts = "Lasts for duration_s" + (", then the stop message is sent; returns after that. " if stops else ". ")
    elif targets.trajectory:
        lasts = "Returns when its time is over; cancelling the call ends it, the joints hold then. "
    properties |= {"timeout_s": SUBSCRIBER_TIMEOUT.schema(), "dry_run": DRY_RUN}
    return DerivedTool(
        name=name,
        title=f"Publish {noun}",
        description=f"{targets.describe()} {lasts}{_SENT}",
        input_schema=object_schema(properties, _required(targets, "message")),
        output_schema=delivery,
        handler=Publishing(gate, targets, name),
    )


def _sequence(name: str, noun: str, targets: Targets, gate: MotionGate, delivery: Schema) -> DerivedTool:
    message: Schema = {"type": "object", "description": f"As `message` of {name.removesuffix('_sequence')}."}
    sequencing = Sequencing(gate, targets, name)
    step = object_schema(
        {"message": message, "duration_s": sequencing.duration.schema()},
        [*(["message"] if message_of(targets.first).fields else []), *([] if targets.trajectory else ["duration_s"])],
    )
    steps: Schema = {
        "type": "array", "items": step, "minItems": 1, "maxItems": MAX_STEPS,
        "description": "Messages in order, each with the time it lasts.",
    }  # fmt: skip
    properties = {
        **targets.schema(),
        "steps": steps,
        "times": TIMES.schema(),
        "timeout_s": SUBSCRIBER_TIMEOUT.schema(),
        "dry_run": DRY_RUN,
    }
    stops = any(e.endpoint.stop_message for e in targets.endpoints)
    end = "It always ends with the stop message, also when it is cancelled or fails. " if stops else ""
    return DerivedTool(
        name=name,
        title=f"Publish {noun}, step by step",
        description=(
            f"{targets.describe()} Plays the steps one after the other, at most {gate.max_duration_s:g} s, and "
            f"returns at the end; cancelling the call or emergency_stop ends it at once. {end}{_SENT}"
        ),
        input_schema=object_schema(properties, _required(targets, "steps")),
        output_schema=delivery,
        handler=sequencing,
    )


def _read(name: str, noun: str, targets: Targets, gate: MotionGate) -> DerivedTool:
    properties = {**targets.schema(), "count": read.COUNT.schema(), "timeout_s": read.TIMEOUT.schema()}
    return DerivedTool(
        name=name,
        title=f"Read {noun}",
        description=f"{targets.describe()} The latched message, or the next one that comes; with `count` the next n.",
        input_schema=object_schema(properties, targets.arguments),
        output_schema=read.reading_schema(targets),
        handler=read.Reading(gate, targets, name),
        read_only=True,
        idempotent=True,
    )


def _service(name: str, noun: str, targets: Targets, gate: MotionGate) -> DerivedTool:
    interface = service_of(targets.first)
    request = message_schema(interface.request, hull([e.endpoint for e in targets.endpoints]))
    properties = {
        **targets.schema(),
        "request": request,
        "timeout_s": service.TIMEOUT.schema(),
        "dry_run": DRY_RUN,
    }
    required = [*targets.arguments, *(["request"] if interface.request.fields else [])]
    return DerivedTool(
        name=name,
        title=f"Call {noun}",
        description=f"{targets.describe()} Calls the service and returns its response.",
        input_schema=object_schema(properties, required),
        output_schema=service.service_schema(targets),
        handler=service.Calling(gate, targets, name),
    )


def _action(name: str, noun: str, targets: Targets, gate: MotionGate) -> DerivedTool:
    interface = action_of(targets.first)
    sending = GoalSending(gate, targets, name)
    properties = {
        **targets.schema(),
        "goal": message_schema(interface.goal, hull([e.endpoint for e in targets.endpoints])),
        "timeout_s": sending.timeout.schema(),
        "server_timeout_s": SERVER.schema(),
        "dry_run": DRY_RUN,
    }
    required = [*targets.arguments, *(["goal"] if interface.goal.fields else [])]
    return DerivedTool(
        name=name,
        title=f"Send a goal: {noun}",
        description=(
            f"{targets.describe()} Sends the goal, reports feedback as progress and returns the result; cancelling the "
            "call, its timeout or emergency_stop cancels the goal. A goal that does not succeed is an error."
        ),
        input_schema=object_schema(properties, required),
        output_schema=goal_schema(targets),
        handler=sending,
    )


def _required(targets: Targets, name: str) -> list[str]:
    needed = name == "steps" or bool(message_of(targets.first).fields)
    return [*targets.arguments, *([name] if needed else [])]
