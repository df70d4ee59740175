"""Random and hostile calls: an error with a reason each time, nothing on the bus, no internals in
the text.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import anyio
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from roboneuron.server.app import Application

Ask = Callable[[Callable[[Any], Any]], None]
INTERNALS = re.compile(
    r"Traceback|File \"|site-packages|\.py\b|object at "
    r"0x|incident|KeyError|TypeError|/root|/work|/home"
)
HUGE = 10**400
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.sampled_from([HUGE, -HUGE, 2**63, -(2**63) - 1, 2**64, 1e308, -1e308, -0.0]),
    st.floats(allow_nan=True, allow_infinity=True),
    st.text(max_size=30),
    st.sampled_from(
        [
            "../../etc/passwd",
            "/rover/cmd_vel",
            "~/x",
            "a\x00b",
            "\ud800",
            "x" * 1_000_000,
            "{{7*7}}",
        ]
    ),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=8,
)
KEYS = st.sampled_from(
    [
        "robot",
        "message",
        "duration_s",
        "timeout_s",
        "simulate",
        "steps",
        "times",
        "request",
        "goal",
        "node",
        "names",
        "parameters",
        "count",
        "tool",
        "arguments",
        "query",
        "linear",
        "x",
        "data",
        "order",
        "type",
        "package",
    ]
)
ARGUMENTS = st.dictionaries(KEYS | st.text(max_size=12), VALUES, max_size=5)


class Context:
    """Runs work on the calling thread."""

    simulated = False

    who, role = "fuzz", "admin"

    async def run(
        self,
        work: Callable[[Callable[[str], None]], Any],
        *,
        on_cancel: Any = None,
        on_leave: Any = None,
    ) -> Any:
        """See `CallContext.run`."""
        return work(lambda stage: None)


def names(application: Application) -> list[str]:
    """Every tool that could reach the robot."""
    return [tool.name for tool in application.tools.derived()] + [
        "describe_interface",
        "list_interfaces",
    ]


def broken(value: Any) -> Any:
    """A value that cannot be valid: something unknown in it."""
    return {**value, "no such argument": 1}


@pytest.fixture
def silent(application: Application, monkeypatch: pytest.MonkeyPatch) -> Application:
    """An application without a bus: whatever wants to send is a failure of the test."""
    from roboneuron.direct_path.traffic import Traffic
    from roboneuron.supervisor.connection import Connection

    def refuse(self: Any, *arguments: Any) -> Any:
        pytest.fail("a malformed call reached the bus")

    monkeypatch.setattr(Connection, "link", refuse)
    monkeypatch.setattr(Traffic, "writer", refuse)
    return application


def check_refused(application: Application, name: str, arguments: dict[str, Any]) -> None:
    """The call is an error whose text tells no internals."""
    answer = anyio.run(lambda: application.tools.call(name, arguments, Context()))
    text = answer.content[0].text  # type: ignore[union-attr]
    assert answer.is_error, (name, arguments)
    assert answer.structured_content is None
    assert answer.meta["roboneuron/error"]["code"] in (
        "invalid_input",
        "refused",
        "configuration",
    ), text
    assert len(text) < 2000
    # the caller's own words are no secret
    assert not INTERNALS.search(text.replace(name, "")), text
    json.dumps(answer.meta, allow_nan=False)


def fuzz(application: Application, examples: int) -> None:
    """Malformed calls of every tool in turn."""
    listed = names(application)

    @settings(
        phases=[Phase.generate],
        derandomize=True,
        max_examples=examples,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        database=None,
    )
    @given(name=st.sampled_from(listed) | st.text(max_size=80), arguments=ARGUMENTS)
    def run(name: str, arguments: dict[str, Any]) -> None:
        check_refused(application, name, broken(arguments))

    run()


@pytest.mark.timeout(120)
def test_a_few_hundred_malformed_calls_are_refused(silent: Application) -> None:
    fuzz(silent, 200)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_ten_thousand_malformed_calls_are_refused(silent: Application) -> None:
    fuzz(silent, 10_000)


DRIVE: dict[str, Any] = {"robot": "rover"}
BAD: list[tuple[str, dict[str, Any]]] = [
    ("publish_velocity", {**DRIVE, "message": {"linear": {"x": float("nan")}}}),
    ("publish_velocity", {**DRIVE, "message": {"linear": {"x": float("inf")}}}),
    ("publish_velocity", {**DRIVE, "message": {"linear": {"x": 1e308}}}),
    ("publish_velocity", {**DRIVE, "message": {"linear": {"x": HUGE}}}),
    ("publish_velocity", {**DRIVE, "message": {"linear": {"x": True}}}),
    ("publish_velocity", {**DRIVE, "message": {"linear": [0.1, 0, 0]}}),
    ("publish_velocity", {**DRIVE, "message": {"linera": {"x": 0.1}}}),
    ("publish_velocity", {**DRIVE, "message": [1]}),
    ("publish_velocity", {**DRIVE, "message": {}, "duration_s": float("nan")}),
    ("publish_velocity", {**DRIVE, "message": {}, "duration_s": 0}),
    ("publish_velocity", {**DRIVE, "message": {}, "duration_s": 1e9}),
    ("publish_velocity", {**DRIVE, "message": {}, "timeout_s": -1}),
    ("publish_velocity", {**DRIVE, "message": {}, "simulate": "yes"}),
    ("publish_velocity", {"robot": "../rover", "message": {}}),
    ("publish_velocity", {"robot": ["rover"], "message": {}}),
    ("publish_velocity", {"message": {}}),
    ("publish_velocity_sequence", {**DRIVE, "steps": []}),
    ("publish_velocity_sequence", {**DRIVE, "steps": {}}),
    ("publish_velocity_sequence", {**DRIVE, "steps": [{"message": {}}]}),
    (
        "publish_velocity_sequence",
        {**DRIVE, "steps": [{"message": {}, "duration_s": 1}], "times": 1.5},
    ),
    ("publish_velocity_sequence", {**DRIVE, "steps": [{"message": {}, "duration_s": 0.001}] * 501}),
    ("publish_speech", {"message": {"data": "x" * 1_000_000}}),
    ("publish_speech", {"message": {"data": "a\x00b"}}),
    ("publish_speech", {"message": {"data": 1}}),
    ("publish_speech", {"message": {"data": "x", "topic": "/other"}}),
    ("publish_speech", {"message": {"data": "x"}, "topic": "/../secret"}),
    ("publish_latched", {"message": {"data": 2**31}}),
    ("publish_latched", {"message": {"data": 1.5}}),
    ("publish_latched", {"message": {}}),
    ("read_battery", {"count": 0}),
    ("read_battery", {"count": 10**9}),
    ("read_battery", {"timeout_s": float("inf")}),
    ("call_light", {"request": {"data": "true"}}),
    ("send_count_goal", {"goal": {"order": -1}}),
    ("send_count_goal", {"goal": {"order": 2**40}}),
    ("set_parameters", {"node": "robot_node", "parameters": {}}),
    ("set_parameters", {"node": "robot_node", "parameters": {"gain": 1e9}}),
    ("get_parameters", {"node": "/rover/other", "names": ["gain"]}),
    ("get_parameters", {"node": "robot_node", "names": [1]}),
    ("describe_interface", {"type": "../../etc/passwd"}),
    ("describe_interface", {"type": "os/msg/System"}),
    ("publish_everything", {}),
]


def test_bad_input_is_refused_before_the_bus(silent: Application) -> None:
    for name, arguments in BAD:
        check_refused(silent, name, arguments)


@pytest.mark.ros
@pytest.mark.timeout(120)
def test_malformed_calls_over_mcp_leave_the_bus_silent_and_the_server_working(
    ask: Ask, rover: Any
) -> None:
    async def scenario(agent: Any) -> None:
        await agent.do("publish_speech", message={"data": "before"})
        with anyio.fail_after(5):
            while not rover.received:
                await anyio.sleep(0.01)
        for name, arguments in BAD:
            # JSON has no such numbers
            if not re.search(r"nan|inf", repr(arguments), re.IGNORECASE):
                answer = await agent.call(name, arguments)
                assert answer.is_error, (name, arguments)
                assert not INTERNALS.search(answer.content[0].text)
        assert len(rover.received) == 1
        assert not rover.goals
        await agent.do("publish_speech", message={"data": "after"})

    ask(scenario)
