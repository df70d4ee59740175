"""Features bring tools, resources, start and close; a broken one does not affect the others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client

from rn_testing.fakes import fake_registry
from roboneuron import (
    CallContext,
    Feature,
    FeatureSpec,
    Host,
    NoArguments,
    Resource,
    Result,
    StateError,
    Tool,
)
from roboneuron.config import Config
from roboneuron.errors import ConfigurationError, RefusedError, RoboNeuronError
from roboneuron.server.app import Application
from roboneuron.server.interception import CallPhase, Interceptor
from roboneuron.server.tool import Transport

TRACE: list[str] = []


class Number(Result):
    value: int


class Odometer(Feature[None]):
    """A feature that brings everything possible."""

    def tools(self, host: Host) -> list[Tool[Any]]:
        async def read(_: NoArguments, context: CallContext) -> Number:
            return Number(value=len(host.modules.views()))

        host.events.fault.listen(lambda module, what, facts: TRACE.append(f"fault {module} {what}"))
        return [
            Tool(
                name="read_odometer",
                title="Read the odometer",
                description="How far the TCP has travelled.",
                arguments=NoArguments,
                result=Number,
                handler=read,
                read_only=True,
            )
        ]

    def resources(self, host: Host) -> list[Resource]:
        return [
            Resource(
                uri="roboneuron://odometer",
                name="o",
                title="O",
                description="D",
                read=lambda: "12 m",
            )
        ]

    def start(self, host: Host) -> None:
        TRACE.append("start")

    def close(self) -> None:
        TRACE.append("close")


class Dependent(Feature[None]):
    def tools(self, host: Host) -> list[Tool[Any]]:
        TRACE.append(type(host.feature("odometer", Odometer)).__name__)
        with pytest.raises(StateError):
            host.feature("odometer", Dependent)
        return []


class Pigeons(Feature[None]):
    """Serves a transport, identifies clients, and refuses actions on Mondays."""

    identifies_clients = True

    def check(self, config: Config) -> None:
        if config.features:
            raise ConfigurationError("There is no loft.")

    def interceptors(self, host: Host) -> list[Interceptor]:
        def refuse(tool: object, context: CallContext) -> None:
            raise RefusedError(f"It is Monday, {context.who}.")

        return [Interceptor(name="monday", phase=CallPhase.ARBITRATION, check=refuse)]

    def listen(self, host: Host) -> Transport:
        async def serve(leave: anyio.Event) -> None:
            TRACE.append(f"serve {host.server.name} on {host.wire}")

        return serve


class BadTools(Feature[None]):
    def tools(self, host: Host) -> list[Tool[Any]]:
        own = Odometer(None).tools(host)
        return [*own, *own]


class BadStart(Feature[None]):
    def start(self, host: Host) -> None:
        raise ConnectionError("no cable")


class BadClose(Odometer):
    def close(self) -> None:
        raise RuntimeError("cannot let go")


class Sender(Feature[None]):
    """Lends a gate, moves something, and is required."""

    gate = "the gate"
    is_moving = True

    def complete(self, host: Host) -> None:
        TRACE.append(f"complete {host.gate}")
        if host.config.server.name == "refusing":
            raise ConfigurationError("Two endpoints are called 'drive'.")

    def end_motion(self, reason: str, timeout_s: float) -> bool:
        TRACE.append(f"end: {reason}")
        return 0.0 <= timeout_s <= 2.0

    def close(self) -> None:
        TRACE.append("close")


class Unstoppable(Feature[None]):
    def end_motion(self, reason: str, timeout_s: float) -> bool:
        raise RuntimeError("no brake")


def spec(cls: type[Any], name: str = "odometer", **more: Any) -> FeatureSpec:
    return FeatureSpec(name=name, summary="A feature.", target=f"{__name__}:{cls.__name__}", **more)


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    import sys

    monkeypatch.setitem(sys.modules, __name__, sys.modules.get(__name__) or _this())
    made: list[Application] = []

    def build(*specs: FeatureSpec, **config: Any) -> Application:
        registry = fake_registry(*specs)
        application = Application(
            Config.model_validate({"robot": {"name": "gantry"}, **config}),
            plugins=lambda: registry,
            directory=tmp_path,
            command=lambda python: pytest.fail("nothing may be spawned"),
        )
        made.append(application)
        return application

    TRACE.clear()
    yield build
    for application in made:
        application.close()


def _this() -> Any:
    import types

    module = types.ModuleType(__name__)
    vars(module).update(globals())
    return module


def test_a_feature_brings_tools_resources_and_a_life_of_its_own(make):
    application = make(spec(Odometer))
    assert "read_odometer" in {tool.name for tool in application.tools.listing("viewer")}
    assert application.resources["roboneuron://odometer"].read() == "12 m"
    assert "roboneuron://odometer" in {resource.uri for resource in application.resources.values()}
    application.features.start(application.host)
    application.events.fault.tell("control", "lease", {})
    application.close()
    assert TRACE == ["start", "fault control lease", "close"]


def test_what_a_feature_needs_is_there_before_it(make):
    make(spec(Dependent, "a-first", needs=("odometer",)), spec(Odometer))
    assert TRACE == ["Odometer"]


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (spec(BadTools, "bad"), "two tools called"),
        (
            FeatureSpec(name="bad", summary="X.", target=f"{__name__}:Missing"),
            "no attribute 'Missing'",
        ),
        (FeatureSpec(name="bad", summary="X.", target=f"{__name__}:Number"), "bad"),
        (spec(Dependent, "bad", needs=("absent",)), "needs the feature 'absent'"),
    ],
)
def test_a_broken_feature_is_left_out_and_the_others_stay(make, broken, reason):
    application = make(broken, spec(Odometer))
    assert reason in application.features.failed["bad"] or reason in broken.name
    names = {tool.name for tool in application.tools.listing()}
    assert {"get_status", "emergency_stop"} <= names
    assert ("read_odometer" in names) == (application.features.loaded.get("odometer") is not None)


def test_a_feature_that_cannot_start_or_close_disturbs_nobody(make):
    application = make(spec(BadStart, "bad"), spec(BadClose))
    application.features.start(application.host)
    assert application.features.failed == {"bad": "ConnectionError: no cable"}
    application.close()


def test_a_feature_that_the_configuration_asks_for_must_work(make):
    with pytest.raises(RoboNeuronError, match="'bad' could not be asked for its tools"):
        make(spec(BadTools, "bad"), features=["bad"])
    with pytest.raises(ConfigurationError, match="There is no feature 'evaluatio'"):
        make(spec(Odometer), features=["evaluatio"])


PIGEON = {"server": {"transport": "pigeon", "name": "loft"}}


def test_a_feature_serves_the_transport_that_is_configured(make):
    pigeons = spec(Pigeons, "pigeons", transports=("pigeon",))
    application = make(pigeons, **PIGEON)
    anyio.run(application.listen((4, 5)), anyio.Event())
    assert TRACE == ["serve loft on (4, 5)"]
    assert application.host.identifies_clients
    with pytest.raises(ConfigurationError, match="There is no feature 'stdio'"):
        make(pigeons).listen((0, 1))
    assert not make().host.identifies_clients


@pytest.mark.parametrize(
    ("specs", "transport", "words"),
    [
        (
            (),
            "http",
            r"'http'.* the package rn-standard brings it.* pip install -r requirements.txt",
        ),
        ((), "pigeon", "There is no feature 'pigeon'"),
        ((spec(Odometer),), "odometer", "choose one of: none"),
        ((spec(BadTools, "x", transports=("bad",)),), "bad", "two tools called"),
    ],
)
def test_a_transport_that_nothing_serves_is_refused(make, specs, transport, words):
    with pytest.raises(RoboNeuronError, match=words):
        make(*specs, server={"transport": transport}).check()


def test_what_a_feature_finds_wrong_is_told_before_anything_is_served(make):
    pigeons = spec(Pigeons, transports=("pigeon",))
    make(pigeons, **PIGEON).check()
    with pytest.raises(ConfigurationError, match="There is no loft"):
        make(pigeons, features=("odometer",), **PIGEON).check()


def test_a_feature_admits_calls(make):
    application = make(spec(Pigeons))

    async def ask() -> Any:
        async with Client(application.server) as client:
            return await client.call_tool("get_status", {})

    application.tools._ready = None  # no ROS here
    answer = anyio.run(ask)
    assert answer.is_error
    assert "It is Monday, agent on stdio." in answer.content[0].text


def test_the_gate_is_what_a_feature_lends(make):
    host = make(spec(Odometer), spec(Sender, "sender")).host
    assert host.gate == "the gate"
    assert host.is_moving
    assert TRACE == ["complete the gate"]


def test_without_such_a_feature_there_is_no_gate_and_the_error_says_which_plugin_has_it(make):
    host = make(spec(Odometer)).host
    with pytest.raises(StateError, match="rn-direct-path"):
        host.gate  # noqa: B018
    assert not host.is_moving
    host.end_motion("Nobody is there.", 1.0)


def test_two_gates_are_refused_by_the_names_of_their_features(make):
    with pytest.raises(
        ConfigurationError, match=r"'one' and 'two' each offer a gate.*disabled_plugins"
    ):
        make(spec(Sender, "two"), spec(Sender, "one"))


def test_what_keeps_a_feature_from_being_complete_keeps_the_server_from_starting(make):
    with pytest.raises(ConfigurationError, match=r"^Two endpoints are called 'drive'"):
        make(spec(Sender, "sender"), server={"name": "refusing"})


def test_motions_of_features_end_before_modules_stop_and_features_close(make, monkeypatch):
    application = make(spec(Unstoppable, "first"), spec(Sender, "second"))
    monkeypatch.setattr(
        application.supervisor, "stop_all", lambda within_s: TRACE.append("stop modules")
    )
    TRACE.clear()
    assert not application.end_direct_motion("The lease has lapsed.", 1.0), (
        "one did not end its motions"
    )
    application.close()
    ended = ["end: The lease has lapsed.", "end: The server is shutting down."]
    assert TRACE[:4] == [*ended, "stop modules", "close"]
