"""expose_endpoint and unexpose_endpoint: checked like the configuration, told to clients, audited,
for admins only.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from mcp import Client

from rn_standard.ops.plugin import CLIENTS
from rn_testing.fakes import fake_registry
from roboneuron import Feature, FeatureSpec
from roboneuron.direct_path.feature import direct_path
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.errors import ConfigurationError, InvalidInputError, RefusedError, StateError
from roboneuron.server.app import Application
from roboneuron.tools.ros.exposing import Admin
from roboneuron.tools.ros.options import ExposeConfig
from roboneuron.tools.ros.plugin import FEATURE

Make = Callable[..., Application]
LOCAL = """
[robot]
name = "rover"
[direct]
expose_without_token = true
[[expose]]
name = "velocity"
kind = "publish"
topic = "cmd_vel"
type = "geometry_msgs/msg/Twist"
bounds = { "linear.x" = [-0.5, 0.5] }
stop_message = "zero"
"""
TOKENS = FeatureSpec(
    name="tokens", summary="Identifies clients.", target="tokens_of_this_test:Tokens"
)
HORN = {
    "name": "horn",
    "kind": "publish",
    "topic": "horn",
    "type": "std_msgs/msg/Bool",
    "rate_hz": 2.0,
}
ADMIN = Admin(who="chief", role="admin", tool="expose_endpoint", arguments={})


class Tokens(Feature[None]):
    """A transport whose clients have tokens."""

    identifies_clients = True


def ros_tools(application: Application) -> Any:
    return application.features.loaded.get(FEATURE.name)


def names(application: Application) -> set[str]:
    return {tool.name for tool in application.tools.listing()}


def records(application: Application) -> list[dict[str, Any]]:
    return [
        json.loads(line)
        for line in direct_path(application.host).judge.audit.path.read_text().splitlines()
    ]


def test_it_is_offered_to_holders_of_a_token_unless_the_configuration_says_otherwise(
    make_application: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tokens_of_this_test", SimpleNamespace(Tokens=Tokens))
    bare = '[robot]\nname = "rover"\n'
    assert "expose_endpoint" not in names(make_application(bare))
    assert {"expose_endpoint", "unexpose_endpoint"} <= names(make_application(LOCAL))
    with_token = make_application(bare, fake_registry(TOKENS, DIRECT_PATH, FEATURE, CLIENTS))
    assert "expose_endpoint" in names(with_token)
    assert "expose_endpoint" not in {tool.name for tool in with_token.tools.listing("operator")}

    async def ask() -> Any:
        async with Client(with_token.server) as client:  # on stdio nobody has a token
            return await client.call_tool("expose_endpoint", HORN)

    answer = anyio.run(ask)
    assert answer.is_error
    assert "needs a token with the role 'admin'" in answer.content[0].text


def test_clients_are_told_and_every_change_is_written_down(make_application: Make) -> None:
    application = make_application(LOCAL)

    async def scenario() -> None:
        async with (
            Client(application.server) as client,
            client.listen(tools_list_changed=True) as events,
        ):
            await client.list_tools()
            made = await client.call_tool("expose_endpoint", HORN)
            assert made.structured_content["added"] == ["publish_horn", "publish_horn_sequence"], (
                made.content
            )
            with anyio.fail_after(5):
                await anext(aiter(events))
            assert "publish_horn" in {tool.name for tool in (await client.list_tools()).tools}
            gone = await client.call_tool("unexpose_endpoint", {"name": "horn"})
            assert gone.structured_content["removed"] == ["publish_horn", "publish_horn_sequence"]
            assert (await client.call_tool("publish_horn", {"message": {"data": True}})).is_error
            assert (await client.call_tool("unexpose_endpoint", {"name": "horn"})).is_error

    anyio.run(scenario)
    told = [(r["tool"], r["verdict"]) for r in records(application)]
    assert told == [("expose_endpoint", "allowed"), ("unexpose_endpoint", "allowed")]
    assert records(application)[0]["arguments"]["topic"] == "horn"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"name": "v"}, "lacks kind, topic, type"),
        ({**HORN, "topic": "../x"}, "is not a topic name"),
        ({**HORN, "type": "std_msgs/msg/Nothing"}, "is called"),
        ({**HORN, "bounds": {"data": [0, 1]}}, "has no number 'data'"),
        ({"name": "velocity", "bounds": {"linear.x": [-2, 2]}}, "can only be tightened"),
        ({**HORN, "stop_message": {"date": False}}, "unknown field 'date'"),
    ],
)
def test_what_the_configuration_may_not_is_refused_here_too(
    make_application: Make, arguments: dict[str, Any], words: str
) -> None:
    application = make_application(LOCAL)
    before = names(application)
    with pytest.raises(ConfigurationError, match=words):
        ros_tools(application).expose(ExposeConfig.model_validate(arguments), ADMIN)
    assert names(application) == before
    assert [r["verdict"] for r in records(application)] == ["refused"]


def test_limits_are_tightened_and_come_back(make_application: Make) -> None:
    application = make_application(LOCAL)

    def bounds() -> Any:
        return next(
            e.endpoint.bounds["linear.x"] for e in direct_path(application.host).judge.allowed()
        )

    entry = ExposeConfig.model_validate({"name": "velocity", "bounds": {"linear.x": [-0.1, 0.1]}})
    change = ros_tools(application).expose(entry, ADMIN)
    assert (change.added, "publish_velocity" in change.changed) == ([], True)
    assert bounds() == (-0.1, 0.1)
    ros_tools(application).refresh()
    assert bounds() == (-0.1, 0.1)
    ros_tools(application).unexpose(None, "velocity", None, ADMIN)
    assert not direct_path(application.host).judge.allowed()
    with pytest.raises(InvalidInputError, match="exposed are: none"):
        ros_tools(application).unexpose(None, "velocity", None, ADMIN)
    again = ExposeConfig.model_validate({"name": "velocity", "kind": "publish"})
    ros_tools(application).expose(again, ADMIN)
    assert bounds() == (-0.5, 0.5)


def test_motion_through_a_withdrawn_endpoint_ends(make_application: Make) -> None:
    application = make_application(LOCAL)
    exposed = application.host.gate.exposed[0]
    entered = threading.Event()

    def move() -> None:
        with direct_path(application.host).arbiter.claim(
            exposed, "a test", threading.Event()
        ) as motion:
            entered.set()
            with pytest.raises(StateError, match="'velocity' was withdrawn"):
                motion.sleep_until(time.monotonic() + 60)

    thread = threading.Thread(target=move)
    thread.start()
    assert entered.wait(5)
    ros_tools(application).unexpose("rover", "velocity", "publish", ADMIN)
    thread.join(5)
    assert not thread.is_alive()


def test_nothing_changes_without_an_audit(make_application: Make, tmp_path: Any) -> None:
    application = make_application(LOCAL)
    (tmp_path / "state").mkdir(exist_ok=True)
    direct_path(application.host).judge.audit.path.mkdir()  # a directory cannot be appended to
    with pytest.raises(RefusedError, match="cannot be written"):
        ros_tools(application).expose(ExposeConfig.model_validate(HORN), ADMIN)
    assert "publish_horn" not in names(application)
