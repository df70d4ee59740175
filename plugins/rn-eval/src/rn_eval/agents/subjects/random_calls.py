"""A random agent: calls any tool with any arguments that its schema allows."""

from __future__ import annotations

import random
from collections.abc import Mapping

from rn_eval.agents.client import Briefing, ToolClient

CALLS = 40
_TIMEOUT_S = 10.0
_DEPTH = 4
_MOST = 3


async def act(tools: ToolClient, briefing: Briefing) -> str:
    """Make random calls from the seed; the robot is started first, so that calls can have
    effects.
    """
    chance = random.Random(f"{briefing.seed} {briefing.instruction}")
    await tools.call("start_all")
    listed = await tools.listed()
    for _ in range(CALLS):
        tool = chance.choice(listed)
        arguments = value_of(tool.input_schema, chance)
        assert isinstance(arguments, dict)
        await tools.call_with(tool.name, arguments, _TIMEOUT_S)
    return chance.choice(("CLAIM: done", "CLAIM: not done: at random", "CLAIM: refused: at random"))


def value_of(schema: Mapping[str, object], chance: random.Random, depth: int = 0) -> object:
    """Draw a value that a JSON schema allows; supports numbers, choices, arrays and objects."""
    choices = schema.get("enum")
    if isinstance(choices, list) and choices:
        return chance.choice(choices)
    for options in (schema.get("anyOf"), schema.get("oneOf")):
        if isinstance(options, list) and options:
            return value_of(chance.choice(options), chance, depth)
    kind = schema.get("type")
    if kind == "boolean":
        return chance.random() < 0.5
    if kind in ("number", "integer"):
        number = chance.uniform(_bound(schema, "inimum", -2.0), _bound(schema, "aximum", 2.0))
        return round(number) if kind == "integer" else number
    if kind == "string":
        return chance.choice(("pick up the red cube", "home", "fr3", "", "a" * 50, "../x"))
    if kind == "array":
        items = schema.get("items")
        count = chance.randint(0, _MOST) if depth < _DEPTH else 0
        inner = items if isinstance(items, Mapping) else {}
        return [value_of(inner, chance, depth + 1) for _ in range(count)]
    return _object(schema, chance, depth)


def _object(schema: Mapping[str, object], chance: random.Random, depth: int) -> object:
    properties = schema.get("properties")
    if not isinstance(properties, Mapping) or depth >= _DEPTH:
        return {}
    required = schema.get("required")
    needed = required if isinstance(required, list) else []
    return {
        name: value_of(inner, chance, depth + 1)
        for name, inner in properties.items()
        if isinstance(inner, Mapping) and (name in needed or chance.random() < 0.4)
    }


def _bound(schema: Mapping[str, object], name: str, otherwise: float) -> float:
    for key in (f"m{name}", f"exclusiveM{name}"):
        value = schema.get(key)
        if isinstance(value, int | float):
            return float(value)
    return otherwise
