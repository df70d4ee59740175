"""Tools shared by several robots: a schema that accepts the arguments of each, and `robot` as the
first argument.

Every agent reads the whole list, so it contains only what a call needs; results are the same as
with one robot, and described in docs/tools.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mcp import types
from pydantic.json_schema import JsonSchemaValue

_WIDER = {"minimum": min, "exclusiveMinimum": min, "minLength": min, "minItems": min}
_WIDER |= {"maximum": max, "exclusiveMaximum": max, "maxLength": max, "maxItems": max}
_MOST_VARIANTS = 4
"""Maximum number of different descriptions that are quoted."""


def merged_tool(
    shown: Mapping[str, types.Tool], namespaces: Mapping[str, str], *, required: bool
) -> types.Tool:
    """Create the list entry of a tool for several robots.

    Args:
        shown: the tool of each robot that has it, by the robot's name.
        namespaces: of all robots by name; written as `<robot>` in texts.
        required: a call has to name the robot.
    """
    first = next(iter(shown.values()))
    schema = widest([tool.input_schema for tool in shown.values()])
    robot = {"type": "string", "enum": list(shown)}
    own = schema.get("properties", {})
    properties = {name: without_summaries(entry) for name, entry in own.items() if name != "robot"}
    needed = [
        *(["robot"] if required else []),
        *(name for name in schema.get("required", ()) if name != "robot"),
    ]
    schema = {**schema, "properties": {"robot": robot, **properties}, "required": needed}
    if not needed:
        del schema["required"]
    texts = {
        name: (tool.description or "").replace(f"/{namespaces[name]}/", "/<robot>/")
        for name, tool in shown.items()
    }
    changed = {"description": merged_text(texts), "input_schema": schema, "output_schema": None}
    return first.model_copy(update=changed)


def without_summaries(entry: JsonSchemaValue) -> JsonSchemaValue:
    """Remove the summaries of an argument's choices: list_* has them, and every robot would add its
    own.
    """
    items = entry.get("items")
    if "enum" not in entry and not (isinstance(items, dict) and "enum" in items):
        return entry
    text = str(entry.get("description", "")).partition(" Choices: ")[0]
    return {
        **{key: value for key, value in entry.items() if key != "description"},
        **({"description": text} if text else {}),
    }


def widest(schemas: Sequence[JsonSchemaValue]) -> JsonSchemaValue:
    """Merge schemas to one that accepts whatever one of them accepts; each robot validates its own
    arguments exactly.
    """
    first, *others = schemas
    if all(other == first for other in others):
        return first
    merged: JsonSchemaValue = {}
    for key in dict.fromkeys(key for schema in schemas for key in schema):
        values = [schema[key] for schema in schemas if key in schema]
        is_everywhere = len(values) == len(schemas)
        if key == "properties":
            named = dict.fromkeys(name for entry in values for name in entry)
            merged[key] = {
                name: widest([entry[name] for entry in values if name in entry]) for name in named
            }
        elif key == "required":
            kept = (
                [name for name in values[0] if all(name in other for other in values)]
                if is_everywhere
                else []
            )
            merged.update({key: kept} if kept else {})
        elif key == "description" or (
            is_everywhere and all(value == values[0] for value in values)
        ):
            merged[key] = values[0]
        elif is_everywhere and key == "enum":
            merged[key] = list(dict.fromkeys(choice for value in values for choice in value))
        elif is_everywhere and key in _WIDER:
            merged[key] = _WIDER[key](values)
        elif is_everywhere and key == "items":
            merged[key] = widest(values)
    return merged


def merged_text(texts: Mapping[str, str]) -> str:
    """Merge texts: the sentences shared by all robots, followed by the others for each kind of
    robot.
    """
    variants: dict[str, list[str]] = {}
    for name, text in texts.items():
        variants.setdefault(text, []).append(name)
    if len(variants) == 1:
        return next(iter(variants))
    sentences = {text: text.split(". ") for text in variants}
    shared = [
        part
        for part in next(iter(sentences.values()))
        if all(part in parts for parts in sentences.values())
    ]
    own = [
        f"{', '.join(names)}: {'. '.join(part for part in sentences[text] if part not in shared)}"
        for text, names in variants.items()
    ]
    if len(own) > _MOST_VARIANTS:
        own = ["Limits differ by robot: see describe_interface"]
    return " ".join(f"{part.rstrip('.')}." for part in (*shared, *own) if part)
