"""The feature lends one gate, ends every motion that passed it, and lets nothing pass once it is
closed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import pytest

from rn_testing.fakes import gantry_profile
from roboneuron.contract import Endpoint
from roboneuron.direct_path.feature import DirectPath, direct_path
from roboneuron.direct_path.plugin import FEATURE
from roboneuron.errors import ConfigurationError, NotReadyError, RefusedError, StateError
from roboneuron.feature import ExposedEndpoint, GateRequest
from roboneuron.modules.report import Report
from roboneuron.modules.settings import FOLLOWING_NOTE
from roboneuron.server.app import Application
from roboneuron.supervisor.health import ModuleView

Make = Callable[..., Application]
DRIVE = Endpoint(
    name="drive", kind="publish", topic="cmd_vel", type="geometry_msgs/msg/Twist", summary="drive",
    bounds={"linear.x": (-0.5, 0.5)}, stop_message="zero",
)  # fmt: skip


@pytest.fixture
def application(application_of: Make) -> Application:
    """A server with the direct path, on which a feature has exposed `drive`."""
    application = application_of(FEATURE)
    application.host.gate.expose("a test", [exposed(DRIVE)])
    return application


def exposed(endpoint: Endpoint) -> ExposedEndpoint:
    return ExposedEndpoint(
        robot="gantry", namespace="gantry", label=endpoint.name, endpoint=endpoint
    )


def drive(application: Application) -> ExposedEndpoint:
    return next(e for e in application.host.gate.exposed if e.label == "drive")


def test_the_profile_is_exposed_when_no_feature_has_exposed_others(application_of: Make) -> None:
    gate = application_of(FEATURE).host.gate
    assert [e.label for e in gate.exposed if e.hidden] == ["ee_delta", "lead"]
    assert {e.endpoint.name for e in gate.exposed if not e.hidden} == {
        e.name for e in gantry_profile().endpoints
    }


def test_a_profile_that_may_not_be_exposed_keeps_the_server_from_starting(
    application_of: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = replace(
        DRIVE, topic="action", type="std_msgs/msg/Float64MultiArray", bounds={}, stop_message=""
    )
    monkeypatch.setattr(
        "roboneuron.direct_path.allow_list.load_profile",
        lambda registry, name: replace(gantry_profile(), endpoints=(bad,)),
    )
    with pytest.raises(ConfigurationError, match="written by RoboNeuron alone"):
        application_of(FEATURE)


def test_a_server_without_the_direct_path_has_no_gate(application_of: Make) -> None:
    with pytest.raises(StateError, match="rn-direct-path"):
        application_of().host.gate  # noqa: B018


def test_what_moves_is_known_and_ended_for_a_reason(application: Application) -> None:
    host, path = application.host, direct_path(application.host)
    assert not host.is_moving
    ended: list[str] = []
    moving = threading.Event()

    def play() -> None:
        with path.arbiter.claim(drive(application), "a test", threading.Event()) as motion:
            moving.set()
            try:
                motion.sleep_until(float("inf"))
            except StateError as error:
                ended.append(error.message)

    player = threading.Thread(target=play)
    player.start()
    assert moving.wait(30.0)
    assert host.is_moving
    host.end_motion("The lease has lapsed.", 30.0)
    player.join(30.0)
    assert ended == ["The lease has lapsed."]
    assert not host.is_moving


def test_a_stop_that_nobody_has_looked_at_yet_ends_no_motion_that_is_asked_for_after_it(
    application: Application, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts, arbiter = application.host.loop.starts, direct_path(application.host).arbiter
    told = ["the server gave no sign of life"]
    monkeypatch.setattr(starts, "look", lambda *_: [starts.note_stop(told.pop()) for _ in told[:]])
    with arbiter.claim(drive(application), "a test", threading.Event()) as motion:
        starts.look()  # as the watching thread and `permit` do
        motion.check()
        starts.note_stop("another stop")
        with pytest.raises(StateError, match="another stop"):
            motion.check()


def test_a_motion_waits_until_control_holds(
    application: Application, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hold that comes later would replace what was sent to the joints."""
    arbiter, looks = direct_path(application.host).arbiter, iter([True, True, False])
    monkeypatch.setattr(arbiter, "_is_followed", lambda exposed: next(looks))
    with arbiter.claim(drive(application), "a test", threading.Event()):
        assert next(looks, None) is None, "it began while control followed actions"


def test_control_that_never_holds_refuses_a_motion_and_leaves_the_robot_free(
    application: Application, monkeypatch: pytest.MonkeyPatch
) -> None:
    arbiter = direct_path(application.host).arbiter
    monkeypatch.setattr(arbiter, "_is_followed", lambda exposed: True)
    monkeypatch.setattr(arbiter, "_hold_s", 0.05)
    with (
        pytest.raises(NotReadyError, match="still receives actions"),
        arbiter.claim(drive(application), "a test", threading.Event()),
    ):
        raise AssertionError
    arbiter.check_free(drive(application))
    action = replace(drive(application), control_input="action")
    with arbiter.claim(action, "move_ee", threading.Event()):
        assert arbiter.claims.is_moving, "the next action needs no hold before it"


def test_control_follows_from_an_action_until_it_holds_or_cannot_say(
    application: Application, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, told = (
        direct_path(application.host),
        {"note": FOLLOWING_NOTE, "age_s": 0.0, "namespace": "gantry"},
    )

    def view(kind: str) -> ModuleView:
        report = Report(
            received_s=time.monotonic() - told["age_s"],
            note=told["note"],
            loop_age_s=0.0,
            ready=True,
        )
        plan = SimpleNamespace(config=SimpleNamespace(namespace=told["namespace"]))
        return ModuleView(kind=kind, phase="running", report=report, plan=plan)

    monkeypatch.setattr(application.supervisor, "view", view)
    assert path._is_followed(drive(application))
    for key, value in (("note", "holding: no action"), ("age_s", 60.0), ("namespace", "another")):
        before, told[key] = told[key], value
        assert not path._is_followed(drive(application)), key
        told[key] = before


def test_nothing_passes_once_it_is_closed(application: Application) -> None:
    path, gate = direct_path(application.host), application.host.gate
    asked = GateRequest(
        who="a", role="operator", tool="t", robot="gantry", endpoint="drive", simulated=True
    )
    assert gate.ask(drive(application), asked).rule == "type"  # it is exposed, and no message came
    path.close()
    path.close()
    assert gate.ask(drive(application), asked).rule == "allow_list"


def test_a_policy_keeps_direct_motion_off_its_robot(
    application: Application, monkeypatch: pytest.MonkeyPatch
) -> None:
    claims = application.loop.starts.claims
    application.loop.starts.begin("pick")
    application.host.gate.check_free(drive(application))
    running = ModuleView(kind="inference", phase="running")
    monkeypatch.setattr(application.supervisor, "slot", lambda kind: running)
    monkeypatch.setattr(application.supervisor, "view", lambda kind: running)
    application.host.gate.check_free(drive(application))  # nobody knows which robot it moves
    monkeypatch.setattr(claims, "policy", lambda *_: "The policy 'instant' moves 'gantry'.")
    with pytest.raises(RefusedError, match="The policy 'instant'"):
        application.host.gate.check_free(drive(application))


def test_another_robot_has_other_endpoints(
    application: Application, caplog: pytest.LogCaptureFixture
) -> None:
    gate, told = application.host.gate, []
    application.events.exposed.listen(lambda: told.append(len(gate.exposed)))
    application.events.change.tell("control")
    assert told == []
    application.events.change.tell("robot")
    assert told == [len(gate.exposed)]
    assert not caplog.records


def test_closing_before_the_server_is_put_together_is_harmless() -> None:
    feature = DirectPath(None)
    assert feature.gate is None
    assert not feature.is_moving
    assert feature.end_motion("A test.", 0.0)
    feature.close()
