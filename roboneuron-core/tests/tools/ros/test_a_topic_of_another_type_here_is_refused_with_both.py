"""Topics that this process uses with another type, from every place that names a topic: the call is
refused with both types, and the next one works.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

import anyio
import pytest
from mcp import Client

from rn_standard.ops.plugin import CLIENTS
from rn_standard.tasks.live import LiveCell
from rn_standard.tasks.plugin import FEATURE as TASKS
from rn_testing.fakes import fake_registry
from roboneuron import InvalidInputError
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.selection.plugin import FEATURE as SELECTION
from roboneuron.server.app import Application
from roboneuron.tools.ros.plugin import FEATURE

pytestmark = [pytest.mark.ros, pytest.mark.timeout(90)]
OTHER, HERE = "std_msgs/msg/Bool", "std_msgs/msg/String"
TOPIC = "/rover/other"
ROBOT = '[robot]\nname = "rover"\n[direct]\nexpose_without_token = true\n'
EXPOSED = f"""
[[expose]]
name = "configured"
kind = "KIND"
topic = "{TOPIC}"
type = "{OTHER}"
rate_hz = 5.0
"""
THRESHOLDS = f"""
[events.thresholds.bad]
topic = "{TOPIC}"
type = "{OTHER}"
field = "data"
above = 1.0
[events.thresholds.good]
topic = "weight"
type = "std_msgs/msg/Float64"
field = "data"
above = 1.0
"""
CALLS: dict[str, dict[str, Any]] = {
    "read": {"timeout_s": 1.0},
    "publish": {"message": {"data": True}},
}


def use_here(application: Application) -> Application:
    """Have the server's node use the topic with a type of its own."""
    link = application.supervisor.link
    from std_msgs.msg import String

    link.advertise(String, TOPIC)
    return application


@pytest.mark.parametrize("kind", CALLS)
@pytest.mark.parametrize("how", ["configured", "at_run_time"])
def test_an_endpoint(make_application: Callable[..., Application], kind: str, how: str) -> None:
    text = ROBOT + (EXPOSED.replace("KIND", kind) if how == "configured" else "")
    application = use_here(make_application(text))

    async def scenario() -> None:
        async with Client(application.server) as client:
            if how == "at_run_time":
                entry = {"name": how, "kind": kind, "topic": TOPIC, "type": OTHER, "rate_hz": 5.0}
                await client.call_tool("expose_endpoint", entry)
            for _ in range(2):
                answer = await client.call_tool(f"{kind}_{how}", CALLS[kind])
                text = answer.content[0].text  # type: ignore[union-attr]
                assert answer.is_error
                assert OTHER in text
                assert HERE in text
            assert not (await client.call_tool("list_topics", {})).is_error

    anyio.run(scenario)


def test_the_condition_of_a_task(make_application: Callable[..., Application]) -> None:
    application = use_here(make_application(ROBOT))
    cell = LiveCell(
        application.host,
        None,
        "admin",
        lambda stage: None,
        threading.Event(),
        lambda: "",
        {TOPIC: OTHER},
        [],
    )
    for _ in range(2):
        with pytest.raises(InvalidInputError) as raised:
            cell.open()
        cell.close()
        assert raised.value.path == "until"
        assert OTHER in raised.value.message
        assert HERE in raised.value.message


def test_a_threshold_is_left_out_and_the_others_are_watched(
    make_application: Callable[..., Application], caplog: pytest.LogCaptureFixture
) -> None:
    registry = fake_registry(DIRECT_PATH, FEATURE, CLIENTS, SELECTION, TASKS)
    application = use_here(make_application(ROBOT + THRESHOLDS, registry))
    with caplog.at_level(logging.WARNING):
        application.features.start(application.host)
    warned = [record.getMessage() for record in caplog.records if "'bad'" in record.getMessage()]
    assert len(warned) == 1
    assert OTHER in warned[0]
    assert HERE in warned[0]
    subscribed = {sub.topic_name for sub in application.supervisor.link.node.subscriptions}
    assert "/rover/weight" in subscribed
