"""Who may move the robot: a policy with an instruction, or one call; the later one is refused."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from rn_testing.fakes import fake_registry
from roboneuron.config import parse_config
from roboneuron.direct_path.exposed import ACTION_LABEL, LEAD_LABEL
from roboneuron.direct_path.feature import direct_path
from roboneuron.direct_path.plugin import FEATURE
from roboneuron.errors import RefusedError
from roboneuron.feature import ExposedEndpoint
from roboneuron.server.app import Application

TOOLS = {
    "joints": ("joint_trajectory", ""),
    "ee": (ACTION_LABEL, "action"),
    "publish": ("velocity", ""),
    "goal": ("plan", ""),
    "lead": (LEAD_LABEL, "lead"),
}
"""Kinds of tools: label of the endpoint, and what control takes from it."""
INSTRUCTION = "pick up the red cube"


def endpoint(kind: str, robot: str = "gantry") -> ExposedEndpoint:
    label, control_input = TOOLS[kind]
    made = SimpleNamespace(
        robot=robot,
        namespace=robot,
        topic=label,
        label=label,
        control_input=control_input,
        moves=True,
    )
    return cast(ExposedEndpoint, made)


@pytest.fixture
def application(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Application]:
    """A server whose policy runs."""
    registry = fake_registry(FEATURE)
    made = Application(
        parse_config('[robot]\nname = "gantry"\n', registry=registry),
        plugins=lambda: registry,
        directory=tmp_path,
        command=lambda python: pytest.fail("nothing may be spawned"),
    )
    yield made
    made.close()


STATES = ("stopped", "no instruction", "instruction", "starting", "paused", "shadow", "idle shadow")
"""States of the policy. Paused: a person leads. Shadow: a successor is tried beside it."""


def enter(
    application: Application, state: str, monkeypatch: pytest.MonkeyPatch, stack: ExitStack
) -> None:
    plan = SimpleNamespace(names={"backend": "instant"}, config=SimpleNamespace(namespace="gantry"))
    phase = {"stopped": "stopped", "starting": "starting"}.get(state, "running")
    view = SimpleNamespace(kind="inference", phase=phase, plan=plan, process=None, report=None)
    idle = SimpleNamespace(kind="robot", phase="stopped", plan=None, process=None, report=None)
    supervisor = application.supervisor
    monkeypatch.setattr(supervisor, "view", lambda kind: view if kind == "inference" else idle)
    slot = supervisor.slots["inference"][0]
    monkeypatch.setattr(supervisor, "slot", lambda kind: view if kind == "inference" else slot)
    if state in ("instruction", "starting", "paused", "shadow"):
        application.loop.starts.begin(INSTRUCTION)
    if state == "paused":
        arbiter = direct_path(application.host).arbiter
        stack.enter_context(arbiter.claim(endpoint("lead"), "lead_arm", threading.Event()))


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("kind", TOOLS)
def test_a_tool_may_move_the_robot_unless_a_policy_has_an_instruction(
    application: Application, monkeypatch: pytest.MonkeyPatch, kind: str, state: str
) -> None:
    arbiter = direct_path(application.host).arbiter
    with ExitStack() as stack:
        enter(application, state, monkeypatch, stack)
        is_free = state in ("stopped", "no instruction", "idle shadow")
        if kind == "lead":  # control lets a person or the policy act
            is_free = state != "paused"
        if is_free:
            with arbiter.claim(endpoint(kind), "a tool", threading.Event()) as motion:
                motion.check()
            return
        with pytest.raises(RefusedError) as caught:
            arbiter.claim(endpoint(kind), "a tool", threading.Event()).__enter__()
        assert caught.value.rule == "ownership"
        assert "stop_motion" in caught.value.hint
        if kind != "lead":
            assert INSTRUCTION in caught.value.message or "lead_arm" in caught.value.message


@pytest.mark.parametrize("kind", TOOLS)
def test_an_instruction_is_refused_while_a_tool_moves_the_robot(
    application: Application, kind: str
) -> None:
    starts, arbiter = application.loop.starts, direct_path(application.host).arbiter
    with arbiter.claim(endpoint(kind), "the tool", threading.Event()) as motion:
        if kind == "lead":
            starts.begin(INSTRUCTION)
        else:
            with pytest.raises(RefusedError, match="the tool moves 'gantry'") as caught:
                starts.begin(INSTRUCTION)
            assert caught.value.rule == "ownership"
            assert starts.instruction == ""
        motion.check()  # the earlier one goes on
    starts.begin(INSTRUCTION)


def test_an_idle_policy_may_begin_while_a_tool_moves_the_robot(application: Application) -> None:
    arbiter = direct_path(application.host).arbiter
    with arbiter.claim(endpoint("joints"), "the tool", threading.Event()):
        application.loop.starts.begin("")


def test_of_two_requests_at_once_one_is_refused(
    application: Application, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An instruction and a claim race; never do both own the robot."""
    with ExitStack() as stack:
        enter(application, "no instruction", monkeypatch, stack)
    for _ in range(50):
        application.loop.starts.begin("")
        assert len(_raced(application)) == 1


def _raced(application: Application) -> list[str]:
    """Who owns the robot after an instruction and a claim at once."""
    starts, arbiter = application.loop.starts, direct_path(application.host).arbiter
    barrier, decided, won = threading.Barrier(2), threading.Event(), list[str]()

    def instruct() -> None:
        barrier.wait()
        with suppress(RefusedError):
            starts.begin(INSTRUCTION)
            won.append("policy")
        decided.set()

    def move() -> None:
        barrier.wait()
        with (
            suppress(RefusedError),
            arbiter.claim(endpoint("joints"), "the tool", threading.Event()),
        ):
            won.append("tool")
            assert decided.wait(10.0)

    threads = [threading.Thread(target=one) for one in (instruct, move)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10.0)
    return won
