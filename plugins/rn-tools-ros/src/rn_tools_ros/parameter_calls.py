"""Handlers of the four parameter tools: services of exposed nodes behind the gate."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from typing import Any

from rn_tools_ros.arguments import check_names, take_choice, take_flag, take_list, take_object
from rn_tools_ros.interfaces import Plain, load_message
from rn_tools_ros.parameter_nodes import ParameterNode
from rn_tools_ros.parameter_values import TYPE_WORDS, check_bounds, check_exposed, to_plain, to_value
from rn_tools_ros.service import TIMEOUT
from rn_tools_ros.service_calls import Response, call
from roboneuron.contract import Endpoint
from roboneuron.errors import InvalidInputError, RefusedError
from roboneuron.server.motion.exposed import SET_PARAMETERS, Exposed, gate_request
from roboneuron.server.motion.gate import MotionGate
from roboneuron.server.tool import Answer, CallContext, Stage

MOST = 100
"""Most parameters of one call."""


def parameter_endpoints(nodes: Sequence[ParameterNode]) -> list[Exposed]:
    """The gate's entries: the four services of each node."""
    made = []
    for node in nodes:
        for kind, type_name, end in (
            ("read", "rcl_interfaces/srv/ListParameters", "list_parameters"),
            ("read", "rcl_interfaces/srv/DescribeParameters", "describe_parameters"),
            ("read", "rcl_interfaces/srv/GetParameters", "get_parameters"),
            ("service", SET_PARAMETERS, "set_parameters"),
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
                    robot=node.robot, namespace=node.namespace, label=endpoint.name, endpoint=endpoint,
                    moves=node.moves, hidden=True,
                )
            )  # fmt: skip
    return made


class ParameterCalls:
    """Handlers of the four tools."""

    def __init__(self, nodes: Sequence[ParameterNode], gate: MotionGate) -> None:
        self._nodes = {node.name: node for node in nodes}
        self._entries = {e.label: e for e in parameter_endpoints(nodes)}
        self._gate = gate

    async def list(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Names."""
        from rcl_interfaces.srv import ListParameters  # heavy

        node = self._take_node(arguments, ["node", "timeout_s"])
        request = ListParameters.Request()
        response = await self._ask(context, "list_parameters", node, "list_parameters", request, arguments)
        return Answer(structured={"node": node.name, "names": sorted(node.names & {*response.result.names})})

    async def describe(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Descriptors."""
        from rcl_interfaces.srv import DescribeParameters  # heavy

        node = self._take_node(arguments, ["node", "names", "timeout_s"])
        names = _names(node, arguments)
        request = DescribeParameters.Request(names=names)
        response = await self._ask(context, "describe_parameters", node, "describe_parameters", request, arguments)
        part = load_message("rcl_interfaces/msg/ParameterDescriptor")
        found: dict[str, Plain] = {
            d.name: {**part.decode(d), "type": TYPE_WORDS[d.type] if d.type < len(TYPE_WORDS) else "unknown"}
            for d in response.descriptors
        }
        return Answer(structured={"node": node.name, "parameters": found})

    async def get(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Values."""
        node = self._take_node(arguments, ["node", "names", "timeout_s"])
        names = _names(node, arguments)
        values = await self._values(context, "get_parameters", node, names, arguments)
        return Answer(structured={"node": node.name, "parameters": {n: v for n, (_, v) in values.items()}})

    async def set(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Set after the gate; raises RefusedError when the node does not accept one."""
        from rcl_interfaces.msg import Parameter  # heavy
        from rcl_interfaces.srv import SetParameters  # heavy

        check_names(arguments, ["node", "parameters", "timeout_s", "dry_run"])
        node = self._nodes[take_choice(arguments, "node", list(self._nodes))]
        wanted = take_object(arguments, "parameters", required=True)
        if not 1 <= len(wanted) <= MOST:
            raise InvalidInputError(f"parameters holds {len(wanted)} values, allowed is 1 to {MOST}.")
        dry_run = take_flag(arguments, "dry_run")
        for name, value in wanted.items():
            check_bounds(node, name, value)
        present = await self._values(context, "set_parameters", node, list(wanted), arguments)
        entries = [Parameter(name=n, value=to_value(n, present[n][0], v)) for n, v in wanted.items()]
        request = SetParameters.Request(parameters=entries)
        gate_entry = self._entries[f"{node.name}_set_parameters"]
        asked = gate_request(context, "set_parameters", gate_entry, [request], arguments, dry_run=dry_run)
        timeout_s, halt = TIMEOUT.take("timeout_s", arguments), threading.Event()

        def work(_: Stage) -> Response:
            return call(self._gate, gate_entry, asked, timeout_s, halt)

        done = await context.run(work, on_cancel=halt.set)
        verdict, response = done.verdict, done.message
        answer: dict[str, Any] = {"node": node.name, "dry_run": verdict.dry_run, "allowed": verdict.allowed,
                                  "reason": verdict.reason}  # fmt: skip
        if not verdict.may_send:
            return Answer(structured={**answer, "parameters": {n: v for n, (_, v) in present.items()}})
        refused = [f"{e.name}: {r.reason or 'no reason given'}"
                   for e, r in zip(entries, response.results, strict=False) if not r.successful]  # fmt: skip
        if refused or len(response.results) != len(entries):
            raise RefusedError(f"{node.node} did not accept {'; '.join(refused)[:500] or 'the parameters'}.")
        values = await self._values(context, "set_parameters", node, list(wanted), arguments)
        return Answer(structured={**answer, "parameters": {n: v for n, (_, v) in values.items()}})

    def _take_node(self, arguments: Mapping[str, Any], known: Sequence[str]) -> ParameterNode:
        check_names(arguments, known)
        return self._nodes[take_choice(arguments, "node", list(self._nodes))]

    async def _values(
        self, context: CallContext, tool: str, node: ParameterNode, names: Sequence[str], arguments: Mapping[str, Any]
    ) -> dict[str, tuple[int, Plain]]:
        """Type and value of each. Raises InvalidInputError for a parameter that the node does not have."""
        from rcl_interfaces.srv import GetParameters  # heavy

        request = GetParameters.Request(names=names)
        response = await self._ask(context, tool, node, "get_parameters", request, arguments)
        if len(response.values) != len(names):
            unknown = ", ".join(names[:5])
            raise InvalidInputError(f"{node.node} does not have all of: {unknown}.", hint="See list_parameters.")
        for name, value in zip(names, response.values, strict=True):
            if value.type == 0:
                raise InvalidInputError(f"{node.node} has no parameter {name!r}.", hint="See list_parameters.")
        return {n: (int(v.type), to_plain(v)) for n, v in zip(names, response.values, strict=True)}

    async def _ask(
        self, context: CallContext, tool: str, node: ParameterNode, service: str, message: Any,
        arguments: Mapping[str, Any],
    ) -> Any:  # fmt: skip
        """The response of a service that only reads."""
        entry = self._entries[f"{node.name}_{service}"]
        request = gate_request(context, tool, entry, [message], arguments)
        timeout_s, halt = TIMEOUT.take("timeout_s", arguments), threading.Event()
        done = await context.run(lambda _: call(self._gate, entry, request, timeout_s, halt), on_cancel=halt.set)
        if done.message is None:
            raise RefusedError(done.verdict.reason)
        return done.message


def _names(node: ParameterNode, arguments: Mapping[str, Any]) -> Sequence[str]:
    names = take_list(arguments, "names", MOST)
    for name in names:
        check_exposed(node, name)
    return names
