"""stop_motion of one robot, with fakes in this process: who may call it, and what it answers."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest
from mcp import Client, types

from rn_standard.ops.plugin import MAINTENANCE
from rn_standard.tasks.plugin import FEATURE as TASKS
from rn_standard.teleoperation.plugin import FEATURE as TELEOPERATION
from rn_testing.fakes import fake_registry
from rn_testing.waiting import wait_until
from roboneuron.config import parse_config
from roboneuron.direct_path.feature import direct_path
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.errors import StateError
from roboneuron.feature import ExposedEndpoint
from roboneuron.selection.plugin import FEATURE as SELECTION
from roboneuron.server.app import Application
from roboneuron.tools.arm.plugin import FEATURE as ARM
from roboneuron.tools.arm.plugin import STOP_MOTION
from roboneuron.tools.loop.plugin import FEATURE as LOOP


@pytest.fixture
def application(tmp_path: Any) -> Any:
    registry = fake_registry(
        LOOP, DIRECT_PATH, ARM, STOP_MOTION, SELECTION, TASKS, TELEOPERATION, MAINTENANCE
    )
    text = '[robot]\nname = "gantry"\n[inference]\nbackend = "instant"\n'
    made = Application(
        parse_config(text, registry=registry),
        plugins=lambda: registry,
        directory=tmp_path,
        command=lambda python: pytest.fail("nothing may be spawned"),
    )
    yield made
    made.close()


def call(application: Application, tool: str, **arguments: Any) -> types.CallToolResult:
    async def ask() -> types.CallToolResult:
        async with Client(application.server) as client:
            return await client.call_tool(tool, arguments)

    return anyio.run(ask)


class Motion:
    """A direct motion that goes on until it has to end."""

    def __init__(self, application: Application, tool: str) -> None:
        self._exposed = cast(
            ExposedEndpoint,
            SimpleNamespace(
                robot="gantry",
                topic="joint_trajectory",
                namespace="gantry",
                label="joints",
                moves=True,
                control_input="",
            ),
        )
        self._arbiter = direct_path(application.host).arbiter
        self.ended: StateError | None = None
        self._moves = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(tool,))
        self._thread.start()
        assert self._moves.wait(10.0)

    def _run(self, tool: str) -> None:
        with self._arbiter.claim(self._exposed, tool, threading.Event()) as motion:
            self._moves.set()
            try:
                motion.sleep_until(float("inf"))
            except StateError as error:
                self.ended = error

    def join(self) -> None:
        self._thread.join(10.0)
        assert not self._thread.is_alive()


def test_nothing_moves_is_answered_as_that(application: Application) -> None:
    answer = call(application, "stop_motion")
    assert not answer.is_error
    assert answer.structured_content is not None
    assert answer.structured_content["stopped"] == []
    assert answer.structured_content["at_rest"] is None, "no robot runs"
    assert answer.structured_content["go_on"] == str(application.host.why_still()[0])


@pytest.mark.parametrize("tool", ["move_joints", "move_ee", "send_plan_goal", "lead_arm"])
def test_a_direct_motion_ends_and_is_named(application: Application, tool: str) -> None:
    motion = Motion(application, tool)
    answer = call(application, "stop_motion")
    motion.join()
    assert answer.structured_content is not None
    (stopped,) = answer.structured_content["stopped"]
    assert stopped.startswith(f"{tool} of 'gantry'")
    assert motion.ended is not None
    assert tool in answer.structured_content["go_on"]
    assert application.host.motions == ()


def test_a_tool_that_moves_the_robot_by_another_is_named(application: Application) -> None:
    motion = Motion(application, "move_ee")
    calling = SimpleNamespace(
        name="move_to",
        tool=SimpleNamespace(simulated_by={"twin"}),
        context=SimpleNamespace(simulated=False),
    )
    application.host.tools.chain.running[0] = cast(Any, calling)
    answer = call(application, "stop_motion").structured_content
    motion.join()
    assert answer is not None
    assert answer["stopped"][0].startswith("move_to: move_ee of 'gantry'")
    assert "move_to" in answer["go_on"]
    assert "move_ee" not in answer["go_on"]


def test_a_policy_s_instruction_is_what_would_go_on(application: Application) -> None:
    application.loop.starts.begin("pick up the red cube")
    answer = call(application, "stop_motion")
    assert answer.structured_content is not None
    assert "pick up the red cube" in answer.structured_content["go_on"]
    assert application.loop.starts.instruction == ""


def test_it_latches_nothing_and_voids_only_what_was_asked_before(application: Application) -> None:
    starts = application.loop.starts
    before = starts.arm_stops
    call(application, "stop_motion")
    assert not application.loop.emergency_stop.is_latched()
    with pytest.raises(StateError):
        starts.permit(before)
    starts.permit(starts.arm_stops)


def test_a_stop_of_the_policy_names_what_moves_all_the_same(application: Application) -> None:
    motion = Motion(application, "move_ee")
    answer = call(application, "stop_inference")
    assert answer.is_error
    text = cast(types.TextContent, answer.content[0]).text
    assert "move_ee of 'gantry'" in text
    assert "stop_motion" in text
    call(application, "stop_motion")
    motion.join()
    text = cast(types.TextContent, call(application, "stop_inference").content[0]).text
    assert "stop_motion" not in text


def test_it_is_always_allowed_as_the_emergency_stop_is(application: Application) -> None:
    tools = application.tools
    stop, emergency = tools.get("stop_motion"), tools.get("emergency_stop")
    assert stop is not None
    assert emergency is not None
    assert stop.always
    assert stop.least_role == emergency.least_role


def test_a_task_ends_with_the_stop(application: Application) -> None:
    begun, halt = threading.Event(), threading.Event()
    feature: Any = application.features.loaded["tasks"]

    def work() -> None:
        with feature._arbiter.claim("'pick up' of a test", halt):
            begun.set()
            wait_until(lambda: application.loop.starts.arm_stops > 0, 10.0, "a stop")

    task = threading.Thread(target=work)
    task.start()
    assert begun.wait(10.0)
    answer = call(application, "stop_motion")
    task.join(10.0)
    assert answer.structured_content is not None
    assert answer.structured_content["stopped"] == ["run_task 'pick up' of a test"]
