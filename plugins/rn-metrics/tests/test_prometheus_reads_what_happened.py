"""What Prometheus gets from a server whose tools were called."""

from __future__ import annotations

from types import SimpleNamespace
from urllib.error import URLError
from urllib.request import urlopen

import anyio
import pytest
from mcp import Client
from prometheus_client.parser import text_string_to_metric_families

from rn_metrics.plugin import FEATURE
from rn_standard.http.plugin import FEATURE as HTTP
from rn_testing.fakes import fake_registry
from roboneuron.config import parse_config
from roboneuron.errors import RefusedError, StateError
from roboneuron.gate.audit import AuditRecord
from roboneuron.server.app import Application
from roboneuron.server.interception import EndedCall, IncomingCall
from roboneuron.server.tool import Answer

CONFIG = """
[robot]
name = "gantry"
namespace = "{namespace}"
[metrics]
prometheus = {prometheus}
port = 0
"""


@pytest.fixture
def serve(tmp_path):
    """Return a function that makes a server with the feature; nothing is started and no ROS is
    touched.
    """
    made = []

    def make(*, prometheus=True, namespace="gantry"):
        registry = fake_registry(HTTP, FEATURE)
        application = Application(
            parse_config(CONFIG.format(prometheus=str(prometheus).lower(), namespace=namespace)),
            plugins=lambda: registry,
            directory=tmp_path,
            command=lambda python: pytest.fail("nothing may be spawned"),
        )
        made.append(application)
        application.events.open.tell()
        application.features.start(application.host)
        return application, application.features.loaded.get("metrics")

    yield make
    for application in made:
        application.close()


def scrape(feature):
    """Samples by name and labels; those of the only robot without its label."""
    with urlopen(f"http://127.0.0.1:{feature.port}/metrics", timeout=30) as answer:
        text = answer.read().decode()
    return {
        (
            sample.name,
            *sorted(label for label in sample.labels.items() if label != ("robot", "gantry")),
        ): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def call(feature, name, outcome="answered", **ended):
    asked = IncomingCall(
        name=name,
        arguments={},
        context=SimpleNamespace(),
        found=None if name.startswith("made up") else SimpleNamespace(),
    )
    feature.meters.on_call(EndedCall(call=asked, outcome=outcome, took_s=0.1, **ended))


def test_calls_are_counted_by_tool_and_result(serve):
    _, feature = serve()
    call(feature, "get_status")
    call(feature, "get_status")
    call(feature, "start_robot", error=StateError("It runs."))
    call(feature, "start_robot", outcome="cancelled")
    call(feature, "start_robot", outcome="asked")
    call(feature, "made up by a client")
    found = scrape(feature)
    assert found["roboneuron_tool_calls_total", ("result", "ok"), ("tool", "get_status")] == 2
    assert (
        found["roboneuron_tool_calls_total", ("result", "wrong_state"), ("tool", "start_robot")]
        == 1
    )
    for result in ("cancelled", "ok"):
        key = ("result", result), ("tool", "start_robot")
        assert found["roboneuron_tool_calls_total", *key] == 1
    assert found["roboneuron_tool_calls_total", ("result", "ok"), ("tool", "unknown")] == 1
    assert found["roboneuron_tool_call_seconds_count", ("tool", "get_status")] == 2


def test_a_call_that_failed_is_counted_by_its_code_when_a_client_makes_it(serve):
    application, feature = serve()

    async def ask():
        async with Client(application.server) as client:
            await client.call_tool("get_status", {})
            await client.call_tool("get_status", {"nonsense": 1})

    anyio.run(ask)
    found = scrape(feature)
    assert found["roboneuron_tool_calls_total", ("result", "ok"), ("tool", "get_status")] == 1
    assert (
        found["roboneuron_tool_calls_total", ("result", "invalid_input"), ("tool", "get_status")]
        == 1
    )


def test_decisions_of_the_gate_are_counted(serve):
    application, feature = serve()
    audit = application.host.audit
    for verdict, rule in (("allowed", ""), ("refused", "rate"), ("refused", "rate")):
        audit.write(
            AuditRecord(
                who="a", role="admin", tool="t", endpoint="wheels", verdict=verdict, rule=rule
            )
        )
    found = scrape(feature)
    key = "roboneuron_gate_verdicts_total"
    assert found[key, ("endpoint", "wheels"), ("rule", "rate"), ("verdict", "refused")] == 2
    assert found[key, ("endpoint", "wheels"), ("rule", ""), ("verdict", "allowed")] == 1


def test_an_emergency_stop_is_counted_once_whoever_pressed_it(serve):
    application, feature = serve()
    assert scrape(feature)["roboneuron_emergency_stop",] == 0
    application.loop.emergency_stop.file.press(who="another process", reason="")
    feature.meters.look()
    feature.meters.look()
    found = scrape(feature)
    assert found["roboneuron_emergency_stop",] == 1
    assert found["roboneuron_emergency_stops_total",] == 1


def test_every_module_has_one_health(serve):
    _, feature = serve()
    found = scrape(feature)
    health = {
        key[1:]: value for key, value in found.items() if key[0] == "roboneuron_module_health"
    }
    assert health[("health", "stopped"), ("module", "robot")] == 1
    assert sum(health.values()) == 4


def test_nothing_listens_unless_asked_for(serve):
    _, feature = serve(prometheus=False)
    assert feature.port == 0
    assert feature.meters is None


def test_robots_of_one_server_share_an_endpoint_and_are_told_apart_by_a_label(serve):
    (left, of_left), (_, of_right) = serve(namespace="left"), serve(namespace="right")
    assert of_left.port == of_right.port
    call(of_right, "get_status")
    found = scrape(of_left)
    assert (
        found[
            "roboneuron_tool_calls_total",
            ("result", "ok"),
            ("robot", "right"),
            ("tool", "get_status"),
        ]
        == 1
    )
    assert found["roboneuron_emergency_stop", ("robot", "left")] == 0
    assert found["roboneuron_emergency_stop", ("robot", "right")] == 0
    health = [key for key in found if key[0] == "roboneuron_module_health"]
    assert all(dict(key[1:])["robot"] in ("left", "right") for key in health)
    left.close()
    assert list(stops_of(scrape(of_right))) == ["right"]


def stops_of(found):
    return {
        dict(key[1:])["robot"]: value
        for key, value in found.items()
        if key[0] == "roboneuron_emergency_stop"
    }


def test_the_last_robot_ends_the_endpoint(serve):
    robots = [serve(namespace=name) for name in ("left", "right")]
    for application, _ in robots:
        application.close()
    with pytest.raises(URLError):
        scrape(robots[0][1])
    _, later = serve()
    assert scrape(later)["roboneuron_emergency_stop",] == 0


def test_the_metrics_of_the_only_robot_name_it_too(serve):
    _, feature = serve()
    with urlopen(f"http://127.0.0.1:{feature.port}/metrics", timeout=30) as answer:
        lines = [line for line in answer.read().decode().splitlines() if not line.startswith("#")]
    assert lines
    assert all('robot="gantry"' in line for line in lines)


def test_tasks_are_counted_by_outcome(serve):
    _, feature = serve()

    for outcome in ("succeeded", "succeeded", "failed", "made up"):
        call(feature, "run_task", answer=Answer(structured={"outcome": outcome}))
    call(feature, "run_task", error=RefusedError("It is Monday.", rule="monday"))
    found = scrape(feature)
    assert found["roboneuron_tasks_total", ("outcome", "succeeded")] == 2
    assert found["roboneuron_tasks_total", ("outcome", "failed")] == 1
    assert found["roboneuron_tasks_total", ("outcome", "unclear")] == 0
    assert found["roboneuron_task_seconds_count", ("outcome", "succeeded")] == 2
    assert not [key for key in found if "made up" in str(key)]
