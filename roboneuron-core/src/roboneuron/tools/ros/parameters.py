"""The four parameter tools: list, describe, get and set parameters of exposed nodes."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic.json_schema import JsonSchemaValue

from roboneuron.direct_path.derived import Derived
from roboneuron.server.motion_gate import MotionGate
from roboneuron.server.tool import Tool
from roboneuron.tools.ros.parameter_calls import (
    ListParameters,
    NamedParameters,
    ParameterCalls,
    ParameterNames,
    Parameters,
    SetParameters,
    Setting,
)
from roboneuron.tools.ros.parameter_nodes import ParameterNode


def parameter_tools(nodes: Sequence[ParameterNode], gate: MotionGate) -> list[Tool]:
    """Create the four tools; none without an exposed node."""
    if not nodes:
        return []
    calls = ParameterCalls(nodes, gate)
    node: JsonSchemaValue = {"enum": [node.name for node in nodes]}
    value: JsonSchemaValue = {
        "description": "A boolean, number or text, or a list of such.",
        "type": ["boolean", "number", "string", "array"],
        "items": {"type": ["boolean", "number", "string"]},
    }
    named = Derived(
        model=NamedParameters,
        properties={"node": node, "names": {}, "timeout_s": {}},
        required=["node", "names"],
    )
    limits = "; ".join(
        f"{each.name}: "
        + ", ".join(f"{name} {low:g} .. {high:g}" for name, (low, high) in each.bounds.items())
        for each in nodes
        if each.bounds
    )
    return [
        Tool(
            name="list_parameters",
            title="List parameters",
            description="Names of the exposed parameters of a node.",
            arguments=Derived(
                model=ListParameters, properties={"node": node, "timeout_s": {}}, required=["node"]
            ),
            result=ParameterNames,
            handler=calls.list,
            read_only=True,
            idempotent=True,
            open_world=True,
        ),
        Tool(
            name="describe_parameters",
            title="Describe parameters",
            description="Type, description, range and constraints of parameters of an exposed "
            "node.",
            arguments=named,
            result=Parameters,
            handler=calls.describe,
            read_only=True,
            idempotent=True,
            open_world=True,
        ),
        Tool(
            name="get_parameters",
            title="Get parameters",
            description="Present values of parameters of a node.",
            arguments=named,
            result=Parameters,
            handler=calls.get,
            read_only=True,
            idempotent=True,
            open_world=True,
        ),
        Tool(
            name="set_parameters",
            title="Set parameters",
            description=(
                "Set parameters of an exposed node; a value is converted to the parameter's own "
                "type. All must be "
                f"accepted.{f' Limits: {limits}.' if limits else ''}"
            ),
            arguments=Derived(
                model=SetParameters,
                properties={
                    "node": node,
                    "parameters": {"additionalProperties": value},
                    "timeout_s": {},
                },
                required=["node", "parameters"],
            ),
            result=Setting,
            handler=calls.set,
            simulated_by=frozenset({"limits"}),
            idempotent=True,
            open_world=True,
        ),
    ]
