"""A simulated call sends nothing, whoever requests it and whatever forbids motion; and it reports
what the real limits would do.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import anyio
import numpy as np
import pytest
from mcp import Client

from rn_robot_fr3.profile import HOME_RAD
from rn_robot_fr3.scene import random_cubes
from rn_robot_fr3.world import JOINTS
from rn_simulation.scene_state import SceneState, at_rest, to_message
from rn_standard.http.feature import HttpFeature
from rn_standard.simulate import feature as feature_module
from rn_standard.simulate.feature import SimulateFeature
from rn_standard.simulate.task import policy_of
from roboneuron.config import parse_config
from roboneuron.config.reading import default_text
from roboneuron.contract import JointSample
from roboneuron.errors import NotReadyError, RefusedError
from roboneuron.feature import GateRequest
from roboneuron.plugins.discovery import discover
from roboneuron.server import surface
from roboneuron.server.app import Application
from roboneuron.server.host import Host
from roboneuron.server.tool import LOCAL_AGENT
from roboneuron.tools.arm.grip import Grip

CELL = """
[simulate]
limit_s = 60.0
[http]
lease_s = 60.0
[places.front]
position_m = [0.45, 0.0, 0.3]
[limits]
obstacles = [{ name = "lamp", lower_m = [0.25, -0.35, 0.02], upper_m = [0.35, -0.25, 0.8] }]
[[limits.zones]]
name = "person"
lower_m = [0.22, 0.12, 0.0]
upper_m = [0.40, 0.30, 0.7]
"""
HOME = JointSample(names=JOINTS, position=np.array([*HOME_RAD, 0.04, 0.04]), stamp_ns=1)
TRAJECTORY = {
    "joint_names": ["fr3_joint1"],
    "points": [
        {"positions": [0.1], "time_from_start": 1.0},
        {"positions": [0.0], "time_from_start": 2.0},
    ],
}
SENDS = ("play", "publish", "publish_now", "send_request", "send_goal", "claim")


@pytest.fixture(scope="module")
def application() -> Iterator[Application]:
    made = Application(parse_config(default_text() + CELL, registry=discover()))
    gate: Any = made.host.gate
    gate.joints = lambda exposed, timeout_s: HOME
    gate.newest_joints = lambda exposed: HOME
    yield made
    made.close()


@pytest.fixture
def sent(application: Application, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Requests to the gate that could move the arm."""
    asked: list[str] = []

    def note(name: str) -> Any:
        own = getattr(application.host.gate, name)

        def refuse(exposed: object, request: object = None, *rest: Any, **more: Any) -> object:
            if isinstance(request, GateRequest) and request.simulated:  # the gate sends nothing
                return own(exposed, request, *rest, **more)
            asked.append(name)
            raise AssertionError(name)

        return refuse

    for name in SENDS:
        monkeypatch.setattr(application.host.gate, name, note(name))
    return asked


def call(application: Application, tool: str, /, **arguments: Any) -> Any:
    async def ask() -> Any:
        async with Client(application.server) as client:
            return await client.call_tool(tool, arguments)

    return anyio.run(ask)


def simulated(application: Application, tool: str, **arguments: Any) -> Mapping[str, Any]:
    answer = call(application, tool, simulate=True, **arguments)
    assert not answer.is_error, answer.content
    assert [part.type for part in answer.content] == ["text", "image"]
    assert answer.content[1].mime_type == "image/png"
    result: Mapping[str, Any] = answer.structured_content
    return result


@pytest.mark.parametrize(
    ("tool", "arguments", "outcome", "rule"),
    [
        ("move_ee", {"dx_m": 0.05, "dz_m": -0.1}, "reached", ""),
        ("move_ee", {"dy_m": 0.45}, "stopped", "zone"),
        ("move_ee", {"dz_m": -0.5}, "stopped", "outside_workspace"),
        ("move_ee", {"dx_m": 0.3, "duration_s": 0.2}, "refused", "speed"),
        ("move_joints", {"positions": {"fr3_joint1": 0.2}}, "reached", ""),
        ("move_joints", {"positions": {"fr3_joint1": -0.6}}, "refused", "collision"),
        ("move_joints", {"positions": {"fr3_joint1": 0.2}, "duration_s": 0.1}, "refused", "joints"),
        ("move_to", {"name": "home"}, "reached", ""),
        ("move_to", {"name": "front"}, "reached", ""),
        ("publish_joint_trajectory", {"message": TRAJECTORY}, "reached", ""),
    ],
)
def test_a_simulated_call_tells_the_outcome_and_sends_nothing(
    application: Application,
    sent: list[str],
    tool: str,
    arguments: dict[str, Any],
    outcome: str,
    rule: str,
) -> None:
    told = simulated(application, tool, **arguments)
    assert (told["outcome"], told["rule"]) == (outcome, rule)
    assert bool(told["reason"]) is (outcome != "reached")
    assert {near["to"] for near in told["nearest"]} >= {"lamp", "itself", "zone person"}
    assert sent == []
    if tool == "move_to" and arguments["name"] == "front":
        assert np.linalg.norm(np.array(told["position_m"]) - [0.45, 0.0, 0.3]) < 0.004


def test_a_latched_stop_keeps_nobody_from_looking(
    application: Application, sent: list[str]
) -> None:
    latch = application.loop.emergency_stop
    latch.file.press(who="ann", reason="a test")
    try:
        told = simulated(application, "move_joints", positions={"fr3_joint1": 0.2})
        assert told["outcome"] == "reached"
        assert "mergency stop" in told["now"]
        assert latch.is_latched()
    finally:
        latch.file.reset(who="ann", role="admin", audit=application.host.audit)
    assert sent == []


def test_a_viewer_looks_while_another_operates_and_touches_no_lease(
    application: Application, sent: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lease = application.host.feature("http", HttpFeature).lease
    assert lease is not None
    lease.take_over("ann", "operator")
    renewed_s = lease._renewed_s
    viewer = replace(LOCAL_AGENT, who="eve", role="viewer")
    monkeypatch.setattr(surface, "holder_of", lambda request: viewer)
    told = simulated(application, "move_joints", positions={"fr3_joint1": 0.2})
    assert told["outcome"] == "reached"
    assert "role" in told["now"]
    assert (lease._operator, lease._renewed_s) == ("ann", renewed_s)
    refused = call(application, "move_joints", positions={"fr3_joint1": 0.2})
    assert refused.meta["roboneuron/error"]["rule"] == "role"
    assert sent == []
    lease.release("ann")


def told_scene() -> Any:
    cubes = random_cubes(3, ("red", "green", "blue", "yellow"))
    return to_message(
        SceneState(
            robot="fr3",
            engine="pybullet",
            seed=3,
            cubes=tuple((cube.name, cube.edge_m) for cube in cubes),
            joints=HOME.position,
            cube_poses=at_rest(cubes),
            stamp_ns=1,
        )
    )


@pytest.mark.parametrize(
    ("colour", "outcome", "rule", "said", "moved"),
    [
        ("red", "reached", "", "", ["red cube"]),
        ("purple", "stopped", "failed", "No purple cube is visible", []),
    ],
)
@pytest.mark.sampled(every=2)
def test_a_task_is_carried_out_in_the_twin(
    application: Application,
    sent: list[str],
    monkeypatch: pytest.MonkeyPatch,
    colour: str,
    outcome: str,
    rule: str,
    said: str,
    moved: list[str],
) -> None:
    monkeypatch.setattr(feature_module, "scene_of", lambda host, twin: told_scene())
    holds = {"kind": "gripper_holds", "least_open": 0.15, "most_open": 0.85}
    high = {"kind": "tcp_in", "lower_m": [0.2, -0.5, 0.15], "upper_m": [0.8, 0.5, 0.4]}
    until = {"kind": "all", "of": [holds, high]}
    instruction = f"pick up the {colour} cube"
    told = simulated(application, "run_task", instruction=instruction, until=until)
    assert (told["outcome"], told["rule"], told["would_move"]) == (outcome, rule, moved)
    assert said in told["reason"]
    assert sent == []


def test_a_task_in_a_cell_that_is_not_known_is_refused(application: Application) -> None:
    answer = call(application, "run_task", instruction="pick up the red cube", simulate=True)
    assert answer.meta["roboneuron/error"]["rule"] == "simulate"
    assert "move_ee" in answer.content[0].text


def test_a_task_of_a_policy_with_a_model_is_refused(application: Application) -> None:
    host = application.host
    inference = host.config.inference
    assert inference is not None
    config = host.config.model_copy(
        update={"inference": inference.model_copy(update={"backend": "oft"})}
    )
    view = SimpleNamespace(plan=SimpleNamespace(config=config))
    modules = SimpleNamespace(view=lambda kind: view)
    with pytest.raises(RefusedError, match="'oft' cannot be simulated") as refused:
        policy_of(cast("Host", SimpleNamespace(modules=modules, registry=host.registry)))
    assert refused.value.rule == "simulate"


def test_a_simulated_call_that_takes_too_long_says_so(
    application: Application, monkeypatch: pytest.MonkeyPatch
) -> None:
    feature = application.host.feature("simulate", SimulateFeature)
    options = feature.options.model_copy(update={"limit_s": 1e-3})
    monkeypatch.setattr(feature, "options", options)
    told = simulated(application, "move_ee", dx_m=0.05)
    assert told["outcome"] == "unclear"
    assert "longer than 0.001 s" in told["reason"]


HELD_M, AIR_M = 0.022, 0.487
"""Half an edge of a held cube, and the height of the TCP at home."""


@pytest.mark.parametrize(
    ("finger_m", "cube_m", "asked", "outcome", "rule"),
    [
        (HELD_M, AIR_M, {"dx_m": 0.1, "dy_m": -0.15}, "reached", ""),
        (HELD_M, AIR_M, {"dx_m": 0.1, "dy_m": -0.15, "height_m": 0.3}, "reached", ""),
        (HELD_M, HELD_M, {"dx_m": 0.1}, "stopped", "lost"),
        (HELD_M, AIR_M, {"dx_m": -0.1, "dy_m": 0.2}, "stopped", "zone"),
        (0.0, HELD_M, {"dx_m": 0.1}, "refused", "empty_hand"),
    ],
)
def test_what_the_hand_holds_is_put_down_in_the_twin(
    application: Application,
    sent: list[str],
    monkeypatch: pytest.MonkeyPatch,
    finger_m: float,
    cube_m: float,
    asked: dict[str, float],
    outcome: str,
    rule: str,
) -> None:
    measured = replace(HOME, position=np.array([*HOME_RAD, finger_m, finger_m]))
    cube = np.array([[0.307, 0.0, cube_m, 0.0, 0.0, 0.0, 1.0]])
    scene = SceneState(
        robot="fr3",
        engine="pybullet",
        seed=3,
        cubes=(("red", 2 * HELD_M),),
        joints=measured.position,
        cube_poses=cube,
        stamp_ns=1,
    )
    monkeypatch.setattr(application.host.gate, "joints", lambda exposed, timeout_s: measured)
    monkeypatch.setattr(feature_module, "scene_of", lambda host, twin: to_message(scene))
    monkeypatch.setattr(Grip, "commanded", lambda self: 0.0)
    told = simulated(application, "place", **{"height_m": 0.025, **asked})
    assert (told["outcome"], told["rule"]) == (outcome, rule)
    assert sent == []
    if outcome == "reached":
        lifted_m = asked.get("height_m", 0.025) + 0.08
        end_m = np.array([0.307 + asked["dx_m"], asked["dy_m"], lifted_m])
        assert np.linalg.norm(np.array(told["position_m"]) - end_m) < 0.006
        assert told["would_move"] == ["red cube"]


def test_a_twin_that_dies_ends_one_simulation_and_not_the_server(
    application: Application, sent: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    feature = application.host.feature("simulate", SimulateFeature)
    turn = {"positions": {"fr3_joint1": 0.2}}
    simulated(application, "move_joints", **turn)
    first = feature._process
    assert first is not None

    def die(duration_s: float) -> None:
        victim = first._process._process
        victim.kill()
        victim.wait(10)
        type(first).advance(first, duration_s)

    monkeypatch.setattr(first, "advance", die)
    answer = call(application, "move_joints", **turn, simulate=True)
    assert answer.is_error
    assert "twin of the cell has ended" in answer.content[0].text
    assert simulated(application, "move_joints", **turn)["outcome"] == "reached"
    second = feature._process
    assert second is not None
    assert second is not first
    feature.close()
    assert not second.is_alive
    assert sent == []


CALLS: dict[str, dict[str, Any]] = {
    "move_ee": {"dx_m": 0.05},
    "move_joints": {"positions": {"fr3_joint1": 0.2}},
    "move_to": {"name": "home"},
    "place": {"dx_m": 0.1},
    "run_task": {"instruction": "pick up the red cube"},
    "publish_joint_trajectory": {"message": TRAJECTORY},
    "publish_joint_trajectory_sequence": {"steps": [{"message": TRAJECTORY}]},
}
"""A call of each tool that can be simulated."""


def acting(application: Application) -> list[str]:
    """Names of the tools that may change something."""
    listed = application.tools.listing()
    return [t.name for t in listed if t.annotations and not t.annotations.read_only_hint]


@pytest.mark.parametrize("twin", ["on", "off", "dead"])
def test_no_tool_that_acts_does_anything_in_a_simulated_call(
    application: Application, sent: list[str], monkeypatch: pytest.MonkeyPatch, twin: str
) -> None:
    if twin == "off":
        monkeypatch.setattr(application.tools.chain, "_simulator", None)
    if twin == "dead":
        lost = NotReadyError("The twin of the cell has ended.")
        monkeypatch.setattr(SimulateFeature, "_twin", Mock(side_effect=lost))
    names = {*acting(application)} - {"emergency_stop", "call_tool"}
    assert {*CALLS} <= names
    for name in sorted(names):
        answer = call(application, name, simulate=True, **CALLS.get(name, {}))
        if answer.is_error:
            error = answer.meta["roboneuron/error"]
            is_twins = "twin" in application.tools.get(name).simulated_by
            assert error.get("rule") == "simulate" or (twin != "off" and is_twins), (name, error)
        else:
            assert answer.structured_content["simulated"] is True, name
            assert name in CALLS
    phases = {view.phase for view in application.host.modules.views()}
    assert phases == {"stopped"}
    assert sent == []


def test_a_tool_that_is_called_by_its_name_is_simulated_too(
    application: Application, sent: list[str]
) -> None:
    name = "publish_joint_trajectory_sequence"
    answer = call(application, "call_tool", tool=name, arguments={**CALLS[name], "simulate": True})
    assert answer.structured_content["simulated"] is True
    assert sent == []


@pytest.mark.parametrize("old", ["dry_run", "preview"])
def test_the_old_names_simulate_and_are_said_to_be_old(
    application: Application, sent: list[str], old: str
) -> None:
    answer = call(application, "move_joints", positions={"fr3_joint1": 0.2}, **{old: True})
    assert answer.structured_content["simulated"] is True
    assert old in answer.structured_content["deprecated"]
    assert sent == []


def test_without_a_twin_the_limits_answer(
    application: Application, sent: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(application.tools.chain, "_simulator", None)
    free = call(application, "move_joints", positions={"fr3_joint1": 0.2}, simulate=True)
    near = call(application, "move_joints", positions={"fr3_joint1": -0.6}, simulate=True)
    assert [a.structured_content["allowed"] for a in (free, near)] == [True, False]
    assert "lamp" in near.structured_content["reason"]
    assert sent == []
