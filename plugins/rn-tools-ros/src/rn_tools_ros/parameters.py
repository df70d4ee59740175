"""The four parameter tools: list, describe, get and set parameters of exposed nodes."""

from __future__ import annotations

from collections.abc import Sequence

from rn_tools_ros.arguments import Schema, choice, object_schema
from rn_tools_ros.parameter_calls import MOST, ParameterCalls
from rn_tools_ros.parameter_nodes import ParameterNode
from rn_tools_ros.service import TIMEOUT
from roboneuron.server.motion.gate import MotionGate
from roboneuron.server.tool import DerivedTool


def parameter_tools(nodes: Sequence[ParameterNode], gate: MotionGate) -> list[DerivedTool]:
    """The four tools; none without an exposed node."""
    if not nodes:
        return []
    calls = ParameterCalls(nodes, gate)
    text = choice("Which node.", [node.name for node in nodes])
    names: Schema = {
        "type": "array", "items": {"type": "string"}, "minItems": 1, "maxItems": MOST, "description": "Which ones."
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
            name="list_parameters", title="List parameters", description="Names of the exposed parameters of a node.",
            input_schema=object_schema({"node": text, **wait}, ["node"]), output_schema=listed,
            handler=calls.list, read_only=True, idempotent=True,
        ),
        DerivedTool(
            name="describe_parameters", title="Describe parameters",
            description="Type, description, range and constraints of parameters of an exposed node.",
            input_schema=object_schema({"node": text, "names": names, **wait}, ["node", "names"]), output_schema=told,
            handler=calls.describe, read_only=True, idempotent=True,
        ),
        DerivedTool(
            name="get_parameters", title="Get parameters", description="Present values of parameters of a node.",
            input_schema=object_schema({"node": text, "names": names, **wait}, ["node", "names"]), output_schema=told,
            handler=calls.get, read_only=True, idempotent=True,
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
                        "type": "object", "additionalProperties": value, "minProperties": 1, "maxProperties": MOST,
                        "description": "Value by name.",
                    },
                    **wait,
                    "dry_run": {"type": "boolean", "default": False, "description": "Only answer what would happen."},
                },
                ["node", "parameters"],
            ),
            output_schema=setting, handler=calls.set, idempotent=True,
        ),
    ]  # fmt: skip
