"""Handlers of the four parameter tools: services of exposed nodes behind the gate."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from roboneuron.contract import Endpoint
from roboneuron.errors import InvalidInputError, RefusedError
from roboneuron.interfaces import Plain, load_interface, load_message
from roboneuron.server.direct.access import Access
from roboneuron.server.direct.arguments import check_names, take_choice, take_flag, take_list, take_object
from roboneuron.server.direct.endpoints import Exposed
from roboneuron.server.direct.parameter_nodes import ParameterNode
from roboneuron.server.direct.parameter_values import TYPE_WORDS, check_bounds, check_exposed, to_plain, to_value
from roboneuron.server.direct.request import gate_request
from roboneuron.server.direct.service import TIMEOUT, await_service, call_service
from roboneuron.server.tool import Answer, CallContext

MOST = 100
"""Most parameters of one call."""


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


class ParameterDesk:
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
        return Answer(structured={"node": node.name, "names": sorted(node.names & {*response.result.names})})

    async def describe(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Descriptors."""
        from rcl_interfaces.srv import DescribeParameters  # heavy

        node = self._read("describe_parameters", arguments, ["node", "names", "timeout_s"], context)
        names = _names(node, arguments)
        request = DescribeParameters.Request(names=names)
        response = await self._ask(context, node, "describe_parameters", DescribeParameters, request, arguments)
        part = load_message("rcl_interfaces/msg/ParameterDescriptor")
        found: dict[str, Plain] = {
            d.name: {**part.decode(d), "type": TYPE_WORDS[d.type] if d.type < len(TYPE_WORDS) else "unknown"}
            for d in response.descriptors
        }
        return Answer(structured={"node": node.name, "parameters": found})

    async def get(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Values."""
        node = self._read("get_parameters", arguments, ["node", "names", "timeout_s"], context)
        names = _names(node, arguments)
        values = await self._values(context, node, names, arguments)
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
        present = await self._values(context, node, list(wanted), arguments)
        entries = [Parameter(name=n, value=to_value(n, present[n][0], v)) for n, v in wanted.items()]
        request = SetParameters.Request(parameters=entries)
        gate_entry = self._gates[f"{node.name}_set_parameters"]
        self._access.desk.check_free(gate_entry)
        verdict = self._access.gate.check(
            gate_request(context, "set_parameters", gate_entry, [request], arguments, dry_run=dry_run)
        )
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
        entry = self._gates[f"{node.name}_get_parameters"]
        self._access.gate.check(gate_request(context, tool, entry, (), arguments))
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
        return {n: (int(v.type), to_plain(v)) for n, v in zip(names, response.values, strict=True)}

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


def _names(node: ParameterNode, arguments: Mapping[str, Any]) -> Sequence[str]:
    names = take_list(arguments, "names", MOST)
    for name in names:
        check_exposed(node, name)
    return names
