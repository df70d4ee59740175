"""One listed tool for robots that differ takes what any of them takes."""

from __future__ import annotations

from mcp import types

from rn_standard.fleet.schemas import merged_text, merged_tool, widest


def number(lower: float, upper: float) -> dict[str, object]:
    return {"type": "number", "minimum": lower, "maximum": upper}


def test_bounds_choices_and_requirements_become_wider() -> None:
    one = {
        "type": "object",
        "properties": {"x": number(-1, 1), "m": {"enum": ["a"]}},
        "required": ["x", "m"],
    }
    two = {
        "type": "object",
        "properties": {"x": number(0, 3), "m": {"enum": ["b", "a"]}},
        "required": ["x"],
    }
    assert widest([one, two]) == {
        "type": "object",
        "properties": {"x": number(-1, 3), "m": {"enum": ["a", "b"]}},
        "required": ["x"],
    }


def test_a_bound_that_one_does_not_have_is_none() -> None:
    assert widest([number(0, 1), {"type": "number", "minimum": 0}]) == {
        "type": "number",
        "minimum": 0,
    }


def test_a_default_that_differs_is_none() -> None:
    assert widest([{"type": "number", "default": 1}, {"type": "number", "default": 2}]) == {
        "type": "number"
    }


def test_equal_schemas_are_one() -> None:
    assert widest([number(0, 1), number(0, 1)]) == number(0, 1)


def test_texts_share_what_they_share() -> None:
    text = merged_text(
        {
            "a": "Drive. Up to 1 m/s. At once.",
            "b": "Drive. Up to 2 m/s. At once.",
            "c": "Drive. Up to 2 m/s. At once.",
        }
    )
    assert text == "Drive. At once. a: Up to 1 m/s. b, c: Up to 2 m/s."


def test_many_kinds_of_robots_do_not_make_the_text_long() -> None:
    texts = {f"r{i}": f"Drive. Up to {i} m/s." for i in range(9)}
    assert merged_text(texts) == "Drive. Limits differ by robot: see describe_interface."


def test_a_robot_argument_of_the_tool_itself_gives_way() -> None:
    own = {
        "type": "object",
        "properties": {"robot": {"enum": ["fr3"]}, "x": number(0, 1)},
        "required": ["robot", "x"],
    }
    tool = types.Tool(name="t", description="On /a/x.", input_schema=own)
    merged = merged_tool(
        {"a": tool, "b": tool.model_copy(update={"description": "On /b/x."})},
        {"a": "a", "b": "b"},
        required=True,
    )
    assert merged.input_schema["properties"]["robot"]["enum"] == ["a", "b"]
    assert merged.input_schema["required"] == ["robot", "x"]
    assert merged.description == "On /<robot>/x."
    assert merged.output_schema is None
