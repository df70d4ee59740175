"""Parameters of exposed nodes: list, describe, get, set; setting passes the gate."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from roboneuron.contract import Endpoint
from roboneuron.errors import InvalidInputError, RefusedError
from roboneuron.gate import GateRequest
from roboneuron.interfaces import Plain, load_interface, load_message
from roboneuron.interfaces.refusal import describe_value
from roboneuron.server.direct.access import Access
from roboneuron.server.direct.arguments import (
    Schema,
    check_names,
    choice,
    object_schema,
    take_choice,
    take_flag,
    take_list,
    take_object,
    take_text,
)
from roboneuron.server.direct.endpoints import Exposed, ParameterNode
from roboneuron.server.direct.service import TIMEOUT, await_service, call_service
from roboneuron.server.tool import Answer, CallContext, DerivedTool

_MOST = 100
_FIELDS = {
    1: "bool_value", 2: "integer_value", 3: "double_value", 4: "string_value", 5: "byte_array_value",
    6: "bool_array_value", 7: "integer_array_value", 8: "double_array_value", 9: "string_array_value",
}  # fmt: skip
"""Field of a ParameterValue by its type. Source: rcl_interfaces/msg/ParameterType."""
_WORDS = ("not set", "bool", "integer", "double", "string", "byte[]", "bool[]", "integer[]", "double[]", "string[]")


def parameter_endpoints(nodes: Sequence[ParameterNode]) -> list[Exposed]:
    """The gate's entries: reading and setting of each node."""
    made = []
    for node in nodes:
        for kind, type_name, end in (
            ("read", "rcl_interfaces/msg/Parameter", "get_parameters"),
            ("service", "rcl_interfaces/srv/SetParameters", "set_parameters"),
        ):
            endpoint = Endpoint(
                name=f"{node.name}_{end}",
                kind=kind,
                topic=f"{node.node}/{end}",
                type=type_name,
                summary="",
                rate_hz=node.rate_hz if kind == "service" else 0.0,
            )
            made.append(
                Exposed(
                    robot=node.robot, namespace=node.robot.replace("-", "_"), label=endpoint.name, endpoint=endpoint,
                    interface=load_interface(type_name), moves=node.moves,
                )
            )  # fmt: skip
    return made


def parameter_tools(nodes: Sequence[ParameterNode], access: Access) -> list[DerivedTool]:
    """The four tools; none without an exposed node."""
    if not nodes:
        return []
    desk = _Parameters(nodes, access)
    text = choice("Which node.", [node.name for node in nodes])
    names: Schema = {
        "type": "array", "items": {"type": "string"}, "minItems": 1, "maxItems": _MOST, "description": "Which ones."
    }  # fmt: skip
    value: Schema = {
        "description": "A boolean, number or text, or a list of such.",
        "type": ["boolean", "number", "string", "array"],
        "items": {"type": ["boolean", "number", "string"]},
    }
    limits = "; ".join(
        f"{node.name}: " + ", ".join(f"{name} {low:g} .. {high:g}" for name, (low, high) in node.bounds.items())
        for node in nodes
        if node.bounds
    )
    values: Schema = {"type": "object", "additionalProperties": True}
    told = object_schema({"node": {"type": "string"}, "parameters": values}, ["node", "parameters"])
    listed = object_schema(
        {"node": {"type": "string"}, "names": {"type": "array", "items": {"type": "string"}}}, ["node", "names"]
    )
    setting = object_schema(
        {
            "node": {"type": "string"},
            "parameters": values,
            "dry_run": {"type": "boolean"},
            "allowed": {"type": "boolean"},
            "reason": {"type": "string"},
        },
        ["node", "parameters", "dry_run", "allowed", "reason"],
    )
    wait = {"timeout_s": TIMEOUT.schema()}
    return [
        DerivedTool(
            name="list_parameters", title="List parameters", description="Names of all parameters of an exposed node.",
            input_schema=object_schema({"node": text, **wait}, ["node"]), output_schema=listed,
            handler=desk.list, read_only=True, idempotent=True,
        ),
        DerivedTool(
            name="describe_parameters", title="Describe parameters",
            description="Type, description, range and constraints of parameters of an exposed node.",
            input_schema=object_schema({"node": text, "names": names, **wait}, ["node", "names"]), output_schema=told,
            handler=desk.describe, read_only=True, idempotent=True,
        ),
        DerivedTool(
            name="get_parameters", title="Get parameters", description="Present values of parameters of a node.",
            input_schema=object_schema({"node": text, "names": names, **wait}, ["node", "names"]), output_schema=told,
            handler=desk.get, read_only=True, idempotent=True,
        ),
        DerivedTool(
            name="set_parameters", title="Set parameters",
            description=(
                "Set parameters of an exposed node; a value is converted to the parameter's own type. All must be "
                f"accepted.{f' Limits: {limits}.' if limits else ''}"
            ),
            input_schema=object_schema(
                {
                    "node": text,
                    "parameters": {
                        "type": "object", "additionalProperties": value, "minProperties": 1, "maxProperties": _MOST,
                        "description": "Value by name.",
                    },
                    **wait,
                    "dry_run": {"type": "boolean", "default": False, "description": "Only answer what would happen."},
                },
                ["node", "parameters"],
            ),
            output_schema=setting, handler=desk.set, idempotent=True,
        ),
    ]  # fmt: skip


class _Parameters:
    """Handlers of the four tools."""

    def __init__(self, nodes: Sequence[ParameterNode], access: Access) -> None:
        self._nodes = {node.name: node for node in nodes}
        self._gates = {e.label: e for e in parameter_endpoints(nodes)}
        self._access = access

    async def list(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Names."""
        from rcl_interfaces.srv import ListParameters  # heavy

        node = self._read("list_parameters", arguments, ["node", "timeout_s"], context)
        response = await self._ask(
            context, node, "list_parameters", ListParameters, ListParameters.Request(), arguments
        )
        return Answer(structured={"node": node.name, "names": sorted(response.result.names)})

    async def describe(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Descriptors."""
        from rcl_interfaces.srv import DescribeParameters  # heavy

        node = self._read("describe_parameters", arguments, ["node", "names", "timeout_s"], context)
        names = _names(arguments)
        request = DescribeParameters.Request(names=names)
        response = await self._ask(context, node, "describe_parameters", DescribeParameters, request, arguments)
        part = load_message("rcl_interfaces/msg/ParameterDescriptor")
        found: dict[str, Plain] = {
            d.name: {**part.decode(d), "type": _WORDS[d.type] if d.type < len(_WORDS) else "unknown"}
            for d in response.descriptors
        }
        return Answer(structured={"node": node.name, "parameters": found})

    async def get(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Values."""
        node = self._read("get_parameters", arguments, ["node", "names", "timeout_s"], context)
        names = _names(arguments)
        values = await self._values(context, node, names, arguments)
        return Answer(structured={"node": node.name, "parameters": {n: v for n, (_, v) in values.items()}})

    async def set(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Set after the gate; raises RefusedError when the node does not accept one."""
        from rcl_interfaces.msg import Parameter  # heavy
        from rcl_interfaces.srv import SetParameters  # heavy

        check_names(arguments, ["node", "parameters", "timeout_s", "dry_run"])
        node = self._nodes[take_choice(arguments, "node", list(self._nodes))]
        wanted = take_object(arguments, "parameters", required=True)
        if not 1 <= len(wanted) <= _MOST:
            raise InvalidInputError(f"parameters holds {len(wanted)} values, allowed is 1 to {_MOST}.")
        dry_run = take_flag(arguments, "dry_run")
        for name, value in wanted.items():
            _check_bounds(node, name, value)
        present = await self._values(context, node, list(wanted), arguments)
        entries = [Parameter(name=n, value=_to_value(n, present[n][0], v)) for n, v in wanted.items()]
        request = SetParameters.Request(parameters=entries)
        gate_entry = self._gates[f"{node.name}_set_parameters"]
        self._access.desk.check_free(gate_entry)
        verdict = self._access.gate.check(
            GateRequest(
                who=context.who, role=context.role, tool="set_parameters", robot=node.robot,
                endpoint=gate_entry.endpoint.name, messages=(request,), arguments=arguments, dry_run=dry_run,
            )
        )  # fmt: skip
        answer: dict[str, Any] = {"node": node.name, "dry_run": verdict.dry_run, "allowed": verdict.allowed,
                                  "reason": verdict.reason}  # fmt: skip
        if not verdict.may_send:
            return Answer(structured={**answer, "parameters": {n: v for n, (_, v) in present.items()}})
        response = await self._ask(context, node, "set_parameters", SetParameters, request, arguments)
        refused = [f"{e.name}: {r.reason or 'no reason given'}"
                   for e, r in zip(entries, response.results, strict=False) if not r.successful]  # fmt: skip
        if refused or len(response.results) != len(entries):
            raise RefusedError(f"{node.node} did not accept {'; '.join(refused)[:500] or 'the parameters'}.")
        values = await self._values(context, node, list(wanted), arguments)
        return Answer(structured={**answer, "parameters": {n: v for n, (_, v) in values.items()}})

    def _read(
        self, tool: str, arguments: Mapping[str, Any], known: Sequence[str], context: CallContext
    ) -> ParameterNode:
        check_names(arguments, known)
        node = self._nodes[take_choice(arguments, "node", list(self._nodes))]
        self._access.gate.check(
            GateRequest(
                who=context.who, role=context.role, tool=tool, robot=node.robot,
                endpoint=f"{node.name}_get_parameters", arguments=arguments,
            )
        )  # fmt: skip
        return node

    async def _values(
        self, context: CallContext, node: ParameterNode, names: Sequence[str], arguments: Mapping[str, Any]
    ) -> dict[str, tuple[int, Plain]]:
        """Type and value of each. Raises InvalidInputError for a parameter that the node does not have."""
        from rcl_interfaces.srv import GetParameters  # heavy

        request = GetParameters.Request(names=names)
        response = await self._ask(context, node, "get_parameters", GetParameters, request, arguments)
        if len(response.values) != len(names):
            unknown = ", ".join(names[:5])
            raise InvalidInputError(f"{node.node} does not have all of: {unknown}.", hint="See list_parameters.")
        for name, value in zip(names, response.values, strict=True):
            if value.type == 0:
                raise InvalidInputError(f"{node.node} has no parameter {name!r}.", hint="See list_parameters.")
        return {n: (int(v.type), _to_plain(v)) for n, v in zip(names, response.values, strict=True)}

    async def _ask(
        self, context: CallContext, node: ParameterNode, end: str, ros_type: Any, request: Any,
        arguments: Mapping[str, Any],
    ) -> Any:  # fmt: skip
        timeout_s = TIMEOUT.take("timeout_s", arguments)
        halt = threading.Event()
        name, traffic = f"{node.node}/{end}", self._access.traffic

        def work(_: Any) -> Any:
            started_s = time.monotonic()
            await_service(traffic, ros_type, name, timeout_s, halt)
            remaining_s = max(0.5, timeout_s - (time.monotonic() - started_s))
            return call_service(traffic, ros_type, name, request, remaining_s, halt)

        return await context.run(work, on_cancel=halt.set)


def _names(arguments: Mapping[str, Any]) -> Sequence[str]:
    names = take_list(arguments, "names", _MOST)
    return [take_text({"names": name}, "names") for name in names]


def _check_bounds(node: ParameterNode, name: str, value: Any) -> None:
    take_text({"parameters": name}, "parameters")
    if not isinstance(value, bool | int | float | str | list):
        raise InvalidInputError(f"Parameter {name!r} is {describe_value(value)}, expected a value or a list of values.")
    if name not in node.bounds:
        return
    low, high = node.bounds[name]
    for item in value if isinstance(value, list) else [value]:
        if isinstance(item, bool) or not isinstance(item, int | float) or not low <= item <= high:
            raise RefusedError(f"{name} is {describe_value(item)}, allowed is {low:g} .. {high:g}.")


def _to_plain(value: Any) -> Plain:
    if value.type not in _FIELDS:
        return None
    found = getattr(value, _FIELDS[value.type])
    if value.type == 5:
        return [item[0] for item in found]
    return list(found) if value.type > 5 else found


def _to_value(name: str, kind: int, given: Any) -> Any:
    """A ParameterValue of the parameter's own type. Raises InvalidInputError when the value is of another."""
    from rcl_interfaces.msg import ParameterValue  # heavy

    try:
        part = load_message("rcl_interfaces/msg/ParameterValue")
        message = part.encode({_FIELDS[kind]: given}, now_ns=None)
    except InvalidInputError as error:
        raise InvalidInputError(
            f"Parameter {name!r} is {describe_value(given)}, expected {_WORDS[kind]}.", path=f"parameters.{name}"
        ) from error
    assert isinstance(message, ParameterValue)
    message.type = kind
    return message
