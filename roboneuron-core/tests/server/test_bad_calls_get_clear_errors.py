"""Invalid calls are refused before anything is spawned, with a code, a message and a remedy."""

from __future__ import annotations

from typing import Any

import anyio
import pytest
from mcp import Client, types

from roboneuron.errors import InternalError
from roboneuron.server.app import Application
from roboneuron.server.tool import Arguments, CallContext, NoArguments, Result, Tool


def call(application: Application, name: str, arguments: dict[str, Any]) -> types.CallToolResult:
    async def ask() -> types.CallToolResult:
        async with Client(application.server) as client:
            return await client.call_tool(name, arguments)

    return anyio.run(ask)


CASES: list[tuple[str, dict[str, Any], str, str]] = [
    ("nonsense", {}, "invalid_input", "There is no tool 'nonsense'"),
    ("get_status", {"module": "robot"}, "invalid_input", "no argument 'module'"),
    ("start_robot", {"robot": "gantry"}, "invalid_input", "no argument 'robot'"),
    ("start_inference", {"instruktion": "go"}, "invalid_input", "Did you mean 'instruction'?"),
    ("start_inference", {"instruction": 3}, "invalid_input", "Argument 'instruction' is 3"),
    ("start_inference", {"instruction": "   "}, "invalid_input", "The instruction is empty."),
    ("start_inference", {"instruction": "x" * 1001}, "invalid_input", "at most 1000 characters"),
    (
        "start_inference",
        {"instruction": "go\0on"},
        "invalid_input",
        "control character U+0000 at position 2",
    ),
    (
        "set_instruction",
        {"instruction": "go\x1b[2J"},
        "invalid_input",
        "control character U+001B at position 2",
    ),
    ("set_instruction", {"instruction": ""}, "invalid_input", "The instruction is empty."),
    ("set_instruction", {}, "invalid_input", "Argument 'instruction' is missing."),
    ("set_instruction", {"instruction": "go"}, "wrong_state", "inference is not running"),
    (
        "set_instruction",
        {"instruction": "go", "timeout_s": -1},
        "invalid_input",
        "Argument 'timeout_s' is -1",
    ),
    ("stop_robot", {}, "wrong_state", "robot is not running"),
]


@pytest.mark.parametrize(
    ("name", "arguments", "code", "words"), CASES, ids=[f"{c[0]}-{c[2]}-{c[3][:24]}" for c in CASES]
)
def test_a_bad_call_is_refused_with_a_reason(
    application: Application, name: str, arguments: dict[str, Any], code: str, words: str
) -> None:
    answer = call(application, name, arguments)
    assert answer.is_error
    assert words in answer.content[0].text  # type: ignore[union-attr]
    assert answer.meta["roboneuron/error"]["code"] == code
    assert all(view.phase == "stopped" for view in application.supervisor.views())


def test_an_unexpected_failure_tells_no_internals(
    application: Application, caplog: pytest.LogCaptureFixture
) -> None:
    async def explode(arguments: NoArguments, context: CallContext) -> Result:
        raise KeyError("/secret/path")

    tool = Tool(
        name="explode",
        title="Explode",
        description="Fails.",
        arguments=NoArguments,
        result=Result,
        handler=explode,
    )
    application.tools.add_all([tool])
    answer = call(application, "explode", {})
    text = answer.content[0].text  # type: ignore[union-attr]
    assert answer.is_error
    assert answer.meta["roboneuron/error"]["code"] == "internal"
    assert "secret" not in text
    assert "KeyError" not in text
    incident = text.split("incident ")[1].split(")")[0]
    assert incident in caplog.text
    assert "/secret/path" in caplog.text


def test_a_refusal_names_its_rule(application: Application) -> None:
    application.latch("a person")
    answer = call(application, "start_inference", {"instruction": "go"})
    details = answer.meta["roboneuron/error"]
    assert (details["code"], details["rule"]) == ("refused", "emergency_stop")
    assert "A person releases it" in details["hint"]
    missing = call(application, "nonsense", {})
    assert "rule" not in missing.meta["roboneuron/error"]


def test_a_request_that_nothing_reads_is_not_passed_over(application: Application) -> None:
    class StartRobot(Arguments):
        robot: str

    with pytest.raises(InternalError, match="cannot read the StartRobot"):
        application.loop.select("robot", StartRobot(robot="other"))
