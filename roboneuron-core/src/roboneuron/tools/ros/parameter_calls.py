"""Handlers of the four parameter tools, which call services of exposed nodes through the gate."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

from pydantic import Field

from roboneuron.contract import Endpoint
from roboneuron.direct_path.exposed import SET_PARAMETERS
from roboneuron.errors import InvalidInputError, RefusedError
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest, MotionGate
from roboneuron.server.tool import Arguments, CallContext, Result
from roboneuron.supervisor.changes import Stage
from roboneuron.tools.ros.interfaces import Plain, load_message
from roboneuron.tools.ros.parameter_nodes import ParameterNode
from roboneuron.tools.ros.parameter_values import (
    TYPE_WORDS,
    check_bounds,
    check_exposed,
    to_plain,
    to_value,
)
from roboneuron.tools.ros.service_calls import Response, call

MOST = 100
"""Maximum number of parameters in one call."""


class ListParameters(Arguments):
    """Arguments of list_parameters."""

    node: str = Field(description="Which node.")
    timeout_s: float = Field(default=10.0, gt=0, le=300, description="Timeout of the answer [s].")


class NamedParameters(ListParameters):
    """Arguments of describe_parameters and get_parameters."""

    names: list[str] = Field(min_length=1, max_length=MOST, description="Their names.")


class SetParameters(ListParameters):
    """Arguments of set_parameters."""

    parameters: dict[str, object] = Field(
        min_length=1, max_length=MOST, description="Value by name."
    )


class ParameterNames(Result):
    """Names of a node's exposed parameters."""

    node: str
    names: list[str]


class Parameters(Result):
    """Values, or descriptions, by name."""

    node: str
    parameters: dict[str, object]


class Setting(Parameters):
    """The values after the call; the present ones after a simulated call."""

    simulated: bool
    allowed: bool
    reason: str


def parameter_endpoints(nodes: Sequence[ParameterNode]) -> list[ExposedEndpoint]:
    """Create the gate's entries: the four services of each node."""
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
                ExposedEndpoint(
                    robot=node.robot,
                    namespace=node.namespace,
                    label=endpoint.name,
                    endpoint=endpoint,
                    moves=node.moves,
                    hidden=True,
                )
            )
    return made


class ParameterCalls:
    """Handlers of the four tools."""

    def __init__(self, nodes: Sequence[ParameterNode], gate: MotionGate) -> None:
        self._nodes = {node.name: node for node in nodes}
        self._entries = {e.label: e for e in parameter_endpoints(nodes)}
        self._gate = gate

    async def list(self, arguments: ListParameters, context: CallContext) -> ParameterNames:
        """List the names."""
        from rcl_interfaces.srv import ListParameters as Listing  # heavy

        node = self._nodes[arguments.node]
        response = await self._ask(
            context, "list_parameters", node, "list_parameters", Listing.Request(), arguments
        )
        return ParameterNames(node=node.name, names=sorted(node.names & {*response.result.names}))

    async def describe(self, arguments: NamedParameters, context: CallContext) -> Parameters:
        """Return the descriptors."""
        from rcl_interfaces.srv import DescribeParameters  # heavy

        node = self._nodes[arguments.node]
        names = _names(node, arguments)
        request = DescribeParameters.Request(names=names)
        response = await self._ask(
            context, "describe_parameters", node, "describe_parameters", request, arguments
        )
        part = load_message("rcl_interfaces/msg/ParameterDescriptor")
        found: dict[str, object] = {
            d.name: {
                **part.decode(d),
                "type": TYPE_WORDS[d.type] if d.type < len(TYPE_WORDS) else "unknown",
            }
            for d in response.descriptors
        }
        return Parameters(node=node.name, parameters=found)

    async def get(self, arguments: NamedParameters, context: CallContext) -> Parameters:
        """Return the values."""
        node = self._nodes[arguments.node]
        names = _names(node, arguments)
        values = await self._values(context, "get_parameters", node, names, arguments)
        shown: dict[str, object] = {n: v for n, (_, v) in values.items()}
        return Parameters(node=node.name, parameters=shown)

    async def set(self, arguments: SetParameters, context: CallContext) -> Setting:
        """Set parameters after the gate's check; raises RefusedError if the node does not accept
        one.
        """
        from rcl_interfaces.msg import Parameter  # heavy
        from rcl_interfaces.srv import SetParameters as Setter  # heavy

        node, wanted = self._nodes[arguments.node], arguments.parameters
        for name, value in wanted.items():
            check_bounds(node, name, value)
        present = await self._values(context, "set_parameters", node, list(wanted), arguments)
        entries = [
            Parameter(name=n, value=to_value(n, present[n][0], v)) for n, v in wanted.items()
        ]
        request = Setter.Request(parameters=entries)
        gate_entry = self._entries[f"{node.name}_set_parameters"]
        asked = GateRequest.of(
            context,
            "set_parameters",
            gate_entry,
            [request],
            arguments.given(),
        )
        halt = threading.Event()

        def work(_: Stage) -> Response:
            return call(self._gate, gate_entry, asked, arguments.timeout_s, halt)

        done = await context.run(work, on_cancel=halt.set)
        verdict, response = done.verdict, done.message

        def setting(values: dict[str, tuple[int, Plain]]) -> Setting:
            return Setting(
                node=node.name,
                simulated=verdict.simulated,
                allowed=verdict.allowed,
                reason=verdict.reason,
                parameters={n: v for n, (_, v) in values.items()},
            )

        if not verdict.may_send:
            return setting(present)
        refused = [
            f"{e.name}: {r.reason or 'no reason given'}"
            for e, r in zip(entries, response.results, strict=False)
            if not r.successful
        ]
        if refused or len(response.results) != len(entries):
            raise RefusedError(
                f"{node.node} did not accept {'; '.join(refused)[:500] or 'the parameters'}.",
                rule="node",
            )
        return setting(await self._values(context, "set_parameters", node, list(wanted), arguments))

    async def _values(
        self,
        context: CallContext,
        tool: str,
        node: ParameterNode,
        names: Sequence[str],
        arguments: ListParameters,
    ) -> dict[str, tuple[int, Plain]]:
        """Type and value of each. Raises InvalidInputError for an unknown parameter."""
        from rcl_interfaces.srv import GetParameters  # heavy

        request = GetParameters.Request(names=names)
        response = await self._ask(context, tool, node, "get_parameters", request, arguments)
        if len(response.values) != len(names):
            unknown = ", ".join(names[:5])
            raise InvalidInputError(
                f"{node.node} does not have all of: {unknown}.", hint="See list_parameters."
            )
        for name, value in zip(names, response.values, strict=True):
            if value.type == 0:
                raise InvalidInputError(
                    f"{node.node} has no parameter {name!r}.", hint="See list_parameters."
                )
        return {n: (int(v.type), to_plain(v)) for n, v in zip(names, response.values, strict=True)}

    async def _ask(
        self,
        context: CallContext,
        tool: str,
        node: ParameterNode,
        service: str,
        message: object,
        arguments: ListParameters,
    ) -> Any:
        """Return the response of a read-only service."""
        entry = self._entries[f"{node.name}_{service}"]
        request = GateRequest.of(context, tool, entry, [message], arguments.given())
        halt = threading.Event()
        done = await context.run(
            lambda _: call(self._gate, entry, request, arguments.timeout_s, halt),
            on_cancel=halt.set,
        )
        if done.message is None:
            raise RefusedError(done.verdict.reason, rule=done.verdict.rule)
        return done.message


def _names(node: ParameterNode, arguments: NamedParameters) -> Sequence[str]:
    for name in arguments.names:
        check_exposed(node, name)
    return arguments.names
