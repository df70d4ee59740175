"""Lasting motion ends in zero whatever ends it: the emergency stop, a cancelled call, a lost
client, an error.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import anyio
import pytest
from mcp import Client

from roboneuron.direct_path.feature import direct_path
from roboneuron.errors import RefusedError, StateError
from roboneuron.gate import StillReason
from roboneuron.server.app import Application

pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(60)]
Ask = Callable[[Callable[[Any], Any]], None]
FORWARD = {"robot": "rover", "message": {"linear": {"x": 0.3}}, "duration_s": 15}
STEPS = [{"message": {"linear": {"x": x}}, "duration_s": 0.15} for x in (0.1, 0.2, 0.3)]
STOPPED_S = 0.5
"""Generous: several jobs share the machine; the benchmark measures how long it really takes."""


async def moving(rover: Any) -> None:
    with anyio.fail_after(10):
        while not rover.received:
            await anyio.sleep(0.002)


async def standing(rover: Any, since_s: float) -> None:
    with anyio.fail_after(5):
        while rover.on("cmd_vel")[-1].linear.x != 0.0:
            await anyio.sleep(0.002)
    assert rover.received[-1][0] - since_s < STOPPED_S
    count = len(rover.received)
    await anyio.sleep(0.15)
    assert len(rover.received) == count


def test_a_sequence_plays_its_steps_in_time_and_ends_in_zero(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        result = await agent.do("publish_velocity_sequence", robot="rover", steps=STEPS, times=2)
        assert result["stopped"]
        assert 0.9 <= result["duration_s"] < 1.2
        with anyio.fail_after(2):
            while len(rover.received) < result["sent"]:
                await anyio.sleep(0.005)
        speeds = [m.linear.x for m in rover.on("cmd_vel")]
        changes = [x for i, x in enumerate(speeds) if i == 0 or x != speeds[i - 1]]
        assert changes == [0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 0.0]
        assert agent.progress[0].startswith("step 1 of 6")

    ask(scenario)


def test_the_emergency_stop_ends_it_and_keeps_everything_from_moving(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        outcome: list[tuple[str, str]] = []

        async def drive() -> None:
            outcome.append(await agent.fail("publish_velocity", **FORWARD))

        async with anyio.create_task_group() as group:
            group.start_soon(drive)
            await moving(rover)
            pressed_s = time.monotonic()
            await agent.do("emergency_stop", reason="a test")
            await standing(rover, pressed_s)
        code, text = outcome[0]
        assert code == "refused"
        assert "the stop message was sent: The emergency stop is latched by" in text
        assert (await agent.fail("publish_velocity", **FORWARD))[0] == "refused"
        assert (await agent.fail("call_light", request={"data": True}))[0] == "refused"
        assert (await agent.fail("send_count_goal", goal={"order": 2}))[0] == "refused"
        await agent.do("reset_emergency_stop")
        assert (await agent.do("call_light", request={"data": True}))["response"]["success"]

    ask(scenario)


def test_the_emergency_stop_cancels_a_goal(application: Application, ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        async def send() -> None:
            code, text = await agent.fail("send_count_goal", goal={"order": 90})
            assert (code, "the goal was ended (canceled)" in text) == ("refused", True)

        async with anyio.create_task_group() as group:
            group.start_soon(send)
            with anyio.fail_after(10):
                while not agent.progress:
                    await anyio.sleep(0.01)
            application.loop.emergency_stop.file.path.touch()  # what any other process may do
        assert rover.goals == ["canceled"]
        await agent.do("reset_emergency_stop")

    ask(scenario)


@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_a_cancelled_call_ends_in_zero(ask: Any, rover: Any, mode: str) -> None:
    async def scenario(agent: Any) -> None:
        with anyio.CancelScope() as scope:
            async with anyio.create_task_group() as group:
                group.start_soon(lambda: agent.call("publish_velocity", FORWARD))
                await moving(rover)
                left_s = time.monotonic()
                scope.cancel()
        await standing(rover, left_s)

    ask(scenario, mode)


def test_a_client_that_leaves_and_a_server_that_closes_leave_nothing_moving(
    application: Application, ask: Ask, rover: Any
) -> None:
    async def scenario(agent: Any) -> None:
        with anyio.CancelScope() as scope:
            async with anyio.create_task_group() as group:
                group.start_soon(lambda: agent.call("publish_velocity", FORWARD))
                await moving(rover)
                scope.cancel()

    ask(scenario)
    left_s = time.monotonic()
    assert application.end_direct_motion("The server is shutting down.", 2.0)
    assert rover.on("cmd_vel")[-1].linear.x == 0.0 or time.monotonic() - left_s < STOPPED_S


def test_one_call_at_a_time_moves_a_robot(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        async with anyio.create_task_group() as group:
            group.start_soon(lambda: agent.call("publish_velocity", FORWARD))
            await moving(rover)
            code, text = await agent.fail("publish_velocity", **FORWARD)
            assert (code, "publish_velocity moves 'rover' now" in text) == ("refused", True)
            dry = await agent.do("publish_velocity", **FORWARD, simulate=True)
            assert (dry["allowed"], dry["rule"]) == (False, "ownership")
            await agent.do("publish_speech", message={"data": "still free"})
            await agent.do("publish_velocity", robot="second", message={}, duration_s=0.1)
            await agent.do("emergency_stop")
        await agent.do("reset_emergency_stop")

    ask(scenario)


def test_a_policy_that_starts_takes_the_robot_over(
    application: Application, ask: Ask, rover: Any
) -> None:
    policy: list[str] = [""]
    application.loop.starts.claims.policy = lambda robot, namespace: policy[0]  # type: ignore[method-assign]

    async def scenario(agent: Any) -> None:
        async def drive() -> None:
            code, text = await agent.fail("publish_velocity", **FORWARD)
            assert (code, "The policy 'x' moves 'rover'." in text) == ("wrong_state", True)

        async with anyio.create_task_group() as group:
            group.start_soon(drive)
            await moving(rover)
            policy[0] = "The policy 'x' moves 'rover'."
            await standing(rover, time.monotonic())
        assert (await agent.fail("publish_velocity", **FORWARD))[0] == "refused"
        assert (await agent.do("publish_speech", message={"data": "moves nothing"}))["sent"] == 1

    ask(scenario)


def test_an_audit_that_cannot_be_written_ends_motion(
    application: Application, ask: Ask, rover: Any
) -> None:
    async def scenario(agent: Any) -> None:
        async def drive() -> None:
            code, text = await agent.fail("publish_velocity", **FORWARD)
            assert (code, "The disk is full." in text) == ("refused", True)

        async with anyio.create_task_group() as group:
            group.start_soon(drive)
            await moving(rover)
            application.host.audit.failure = StillReason(
                rank="server", rule="audit", message="The disk is full."
            )
            await standing(rover, time.monotonic())

    ask(scenario)


def test_a_subscriber_that_leaves_is_an_error(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        async def drive() -> None:
            code, text = await agent.fail("publish_velocity", **FORWARD)
            assert (code, "The subscriber of /rover/cmd_vel is gone" in text) == ("not_ready", True)

        async with anyio.create_task_group() as group:
            group.start_soon(drive)
            await moving(rover)
            rover.node.destroy_subscription(
                next(s for s in rover.node.subscriptions if s.topic_name == "/rover/cmd_vel")
            )

    ask(scenario)


def test_too_long_a_sequence_is_refused_before_anything_is_sent(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        long = [{"message": {}, "duration_s": 15}, {"message": {}, "duration_s": 15}]
        code, text = await agent.fail("publish_velocity_sequence", robot="rover", steps=long)
        assert (code, "would last 30 s, allowed is 20 s" in text) == ("invalid_input", True)
        bad = [*STEPS, {"message": {"linear": {"x": "fast"}}, "duration_s": 1}]
        code, text = await agent.fail("publish_velocity_sequence", robot="rover", steps=bad)
        assert text.startswith("steps[3]: message: Field 'linear.x'")
        outside = [*STEPS, {"message": {"linear": {"x": 9}}, "duration_s": 1}]
        assert (await agent.fail("publish_velocity_sequence", robot="rover", steps=outside))[
            0
        ] == "refused"
        assert not rover.received

    ask(scenario)


def test_the_arbiter_waits_for_motions_to_end(application: Application) -> None:
    exposed = application.host.gate.exposed[0]
    halt, entered = threading.Event(), threading.Event()

    def move() -> None:
        with direct_path(application.host).arbiter.claim(exposed, "a test", halt) as motion:
            entered.set()
            with pytest.raises(StateError, match="It is over"):
                motion.sleep_until(time.monotonic() + 30)

    thread = threading.Thread(target=move)
    thread.start()
    assert entered.wait(5)
    with pytest.raises(RefusedError, match="a test moves 'rover' now"):
        direct_path(application.host).arbiter.check_free(exposed)
    assert direct_path(application.host).arbiter.end_all("It is over.", 2.0)
    thread.join(5)
    direct_path(application.host).arbiter.check_free(exposed)


def test_pressing_the_stop_wakes_what_moves(
    application: Application, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("roboneuron.direct_path.arbiter.POLL_S", 60.0)
    exposed = application.host.gate.exposed[0]
    entered = threading.Event()

    def move() -> None:
        with direct_path(application.host).arbiter.claim(
            exposed, "a test", threading.Event()
        ) as motion:
            entered.set()
            with pytest.raises(RefusedError, match='latched by somebody: "a test"'):
                motion.sleep_until(time.monotonic() + 60)

    thread = threading.Thread(target=move)
    thread.start()
    assert entered.wait(5)
    application.loop.emergency_stop.file.press(who="somebody", reason="a test")
    thread.join(5)
    assert not thread.is_alive()


@pytest.mark.parametrize(
    "arguments", [{"reason": "first of all"}, {"resaon": "misspelt"}, {"reason": 7}]
)
def test_the_stop_is_latched_before_ros_is_joined_and_whatever_the_arguments(
    application: Application, monkeypatch: pytest.MonkeyPatch, arguments: dict[str, Any]
) -> None:
    joined = threading.Event()
    link = type(application.supervisor).link
    monkeypatch.setattr(
        type(application.supervisor),
        "link",
        property(lambda self: joined.wait(30) and link.fget(self)),
    )
    application.tools.chain.ready = application._join_ros
    latch = application.loop.emergency_stop.file

    async def scenario() -> None:
        async with Client(application.server) as client, anyio.create_task_group() as group:
            group.start_soon(lambda: client.call_tool("emergency_stop", arguments))
            with anyio.fail_after(10):
                while not latch.path.exists():
                    await anyio.sleep(0.002)
            assert not joined.is_set()
            joined.set()

    anyio.run(scenario)
    assert latch.is_latched()


def test_the_stop_message_does_not_wait_for_the_thread_that_plays(application: Application) -> None:
    exposed = application.host.gate.exposed[0]
    latch = application.loop.emergency_stop.file
    sent: list[tuple[bool, bool]] = []
    with direct_path(application.host).arbiter.claim(
        exposed, "a test", threading.Event()
    ) as motion:
        motion.stop_now = lambda: sent.append((latch.is_latched(), latch.path.exists()))
        latch.press(who="somebody", reason="a test")
    assert sent == [(True, False)]


def test_the_server_hears_its_own_stop_before_it_is_reset(
    application: Application, ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop, link = application.loop.emergency_stop, application.supervisor.link
    order: list[str] = []
    reset, on_executor = stop.file.reset, link.on_executor
    monkeypatch.setattr(stop.file, "reset", lambda **who: (order.append("reset"), reset(**who)))
    monkeypatch.setattr(
        link, "on_executor", lambda task: (order.append("heard"), on_executor(task))[1]
    )

    async def scenario(agent: Any) -> None:
        await agent.do("emergency_stop")
        order.clear()
        await agent.do("reset_emergency_stop")
        assert order[:2] == ["heard", "heard"]
        assert "reset" in order

    ask(scenario)
