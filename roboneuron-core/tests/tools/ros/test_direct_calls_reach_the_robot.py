"""Every kind of direct tool against a real node: what arrives, what is answered, what is
refused.
"""

from __future__ import annotations

import base64
import threading
from collections.abc import Callable
from typing import Any

import anyio
import pytest
from mcp import types

from rn_testing.waiting import holds_within, wait_until
from roboneuron.server.app import Application

pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(60)]
Ask = Callable[[Callable[[Any], Any]], None]


def test_a_message_arrives_exactly_and_the_answer_says_to_how_many(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        first = await agent.do("publish_speech", message={"data": "hello é"})
        assert (first["sent"], first["subscribers"], first["topic"]) == (1, 1, "/rover/say")
        assert holds_within(lambda: [m.data for m in rover.on("say")] == ["hello é"])
        await agent.do("publish_speech", message={"data": "again"})
        assert holds_within(lambda: [m.data for m in rover.on("say")] == ["hello é", "again"])

    ask(scenario)


def test_a_latching_subscription_is_matched_by_its_own_quality_of_service(
    ask: Ask, rover: Any
) -> None:
    async def scenario(agent: Any) -> None:
        assert (await agent.do("publish_latched", message={"data": 7}))["subscribers"] == 1
        assert holds_within(lambda: [m.data for m in rover.on("mode")] == [7])

    ask(scenario)


def test_a_velocity_lasts_is_repeated_and_ends_in_zero(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        result = await agent.do(
            "publish_velocity", robot="rover", message={"linear": {"x": 1 / 4}}, duration_s=0.3
        )
        assert result["stopped"]
        assert 0.3 <= result["duration_s"] < 0.5
        assert holds_within(lambda: len(rover.on("cmd_vel")) == result["sent"])
        speeds = [m.linear.x for m in rover.on("cmd_vel")]
        assert speeds[-1] == 0.0
        assert set(speeds[:-1]) == {0.25}
        assert 5 <= len(speeds) <= 8
        await agent.do(
            "publish_velocity", robot="second", message={"linear": {"x": 0.1}}, duration_s=0.1
        )
        assert holds_within(lambda: rover.on("/second/cmd_vel")[-1].linear.x == 0.0)
        assert rover.on("/second/cmd_vel")[0].linear.x == 0.1

    ask(scenario)


def test_limits_are_those_of_the_robot_that_is_chosen(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        code, text = await agent.fail(
            "publish_velocity", robot="second", message={"linear": {"x": 0.4}}
        )
        assert code == "refused"
        assert "linear.x is 0.4, allowed is -0.1 .. 0.1" in text
        code, text = await agent.fail("publish_velocity", robot="third", message={})
        assert code == "invalid_input"
        assert "rover, second" in text
        assert (await agent.fail("publish_velocity", message={}))[1].startswith(
            "Argument 'robot' is missing"
        )
        clamped = await agent.do(
            "publish_velocity", robot="rover", message={"angular": {"z": 5}}, duration_s=0.1
        )
        assert clamped["clamped"] == [{"path": "angular.z", "asked": 5.0, "sent": 1.0}]
        assert holds_within(lambda: rover.on("cmd_vel")[0].angular.z == 1.0)
        assert not rover.on("/second/cmd_vel")

    ask(scenario)


def test_nobody_listening_is_an_error_unless_that_is_configured(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        assert (await agent.do("publish_lonely", message={}))["subscribers"] == 0
        rover.node.destroy_subscription(
            next(s for s in rover.node.subscriptions if s.topic_name == "/rover/say")
        )
        code, text = await agent.fail("publish_speech", message={"data": "x"}, timeout_s=0.3)
        assert code == "not_ready"
        assert "/rover/say (std_msgs/msg/String) has no subscriber: nothing was sent." in text

    ask(scenario)


def test_a_subscription_that_asks_for_more_is_served_from_then_on(ask: Ask, rover: Any) -> None:
    """A publisher that fits the first one alone would be kept, and the second would get nothing."""
    from rclpy.duration import Duration
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String

    strict = QoSProfile(
        depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL, deadline=Duration(seconds=5)
    )
    got: list[str] = []

    async def scenario(agent: Any) -> None:
        await agent.do("publish_speech", message={"data": "first"})
        rover.node.create_subscription(String, "say", lambda one: got.append(one.data), strict)
        with anyio.fail_after(20):
            while not got:
                await agent.do("publish_speech", message={"data": "second"})
                await anyio.sleep(0.05)
        assert (await agent.do("publish_speech", message={"data": "third"}))["subscribers"] == 2
        assert "second" in [message.data for message in rover.on("say")]

    ask(scenario)


def test_a_simulated_call_answers_and_sends_nothing(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        allowed = await agent.do(
            "publish_velocity", robot="rover", message={"linear": {"x": 0.2}}, simulate=True
        )
        assert (allowed["simulated"], allowed["allowed"], allowed["sent"]) == (True, True, 0)
        refused = await agent.do(
            "publish_velocity", robot="rover", message={"linear": {"x": 9}}, simulate=True
        )
        assert (refused["allowed"], refused["rule"]) == (False, "bounds")
        light = await agent.do("call_light", request={"data": True}, simulate=True)
        assert light["allowed"]
        assert "response" not in light
        goal = await agent.do("send_count_goal", goal={"order": 3}, simulate=True)
        assert (goal["status"], goal["allowed"]) == ("", True)
        assert not rover.received
        assert not rover.goals

    ask(scenario)


def test_reading_waits_for_messages_and_summarises(ask: Ask, rover: Any) -> None:
    from sensor_msgs.msg import BatteryState, Image

    async def scenario(agent: Any) -> None:
        code, text = await agent.fail("read_battery", timeout_s=0.2)
        assert (code, "Nobody publishes /rover/battery" in text) == ("not_ready", True)
        rover.publish_often(
            BatteryState, "battery", BatteryState(voltage=12.5, temperature=float("nan"))
        )
        got = await agent.do("read_battery", count=3)
        assert got["complete"]
        assert [m["voltage"] for m in got["messages"]] == [12.5] * 3
        assert got["messages"][0]["temperature"] == "NaN"
        few = await agent.do("read_battery", count=100, timeout_s=0.3)
        assert not few["complete"]
        assert 1 <= len(few["messages"]) < 100
        picture = Image(height=2, width=2, encoding="rgb8", step=6, data=bytes(range(12)))
        rover.publish_often(Image, "image", picture)
        answer = await agent.call("read_picture", {})
        assert not answer.is_error
        block = next(b for b in answer.content if isinstance(b, types.ImageContent))
        assert base64.b64decode(block.data)

    ask(scenario)


def test_a_best_effort_and_a_latched_publisher_are_both_heard(
    ask: Ask, rover: Any, application: Any
) -> None:
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import BatteryState

    async def scenario(agent: Any) -> None:
        timer = rover.publish_often(
            BatteryState, "battery", BatteryState(voltage=1.0),
            QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
        )  # fmt: skip
        assert (await agent.do("read_battery"))["messages"][0]["voltage"] == 1.0

        def fall_silent() -> None:
            timer.cancel()
            for publisher in list(rover.node.publishers):
                if publisher.topic_name == "/rover/battery":
                    rover.node.destroy_publisher(publisher)

        # on its thread: a timer that is cancelled when it is due ends the executor
        done = rover.executor.create_task(fall_silent)
        await anyio.to_thread.run_sync(wait_until, done.done)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        successor = rover.node.create_publisher(BatteryState, "battery", latched)
        successor.publish(BatteryState(voltage=2.0))
        assert (await agent.do("read_battery"))["messages"][0]["voltage"] == 2.0
        # Whoever publishes at the same time decides for no longer than it is there.
        other = rover.node.create_publisher(BatteryState, "battery", QoSProfile(depth=1))
        assert holds_within(
            lambda: application.supervisor.link.node.count_publishers("/rover/battery") == 2
        )
        threading.Timer(0.5, rover.node.destroy_publisher, [other]).start()
        assert (await agent.do("read_battery"))["messages"][0]["voltage"] == 2.0

    ask(scenario)


def test_a_service_answers_and_an_absent_one_is_an_error(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        answer = await agent.do("call_light", request={"data": True})
        assert answer["response"] == {"success": True, "message": "on"}
        assert answer["service"] == "/rover/light"
        code, text = await agent.fail("call_absent", timeout_s=0.3)
        assert (code, "/rover/absent had no server" in text) == ("not_ready", True)
        assert (await agent.fail("call_light", request={"data": 1}))[0] == "invalid_input"
        assert (await agent.fail("call_light"))[1].startswith("Argument 'request' is missing")

    ask(scenario)


def test_a_goal_reports_feedback_as_progress_and_its_result(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        done = await agent.do("send_count_goal", goal={"order": 6})
        assert done["status"] == "succeeded"
        assert done["result"]["sequence"] == [0, 1, 1, 2, 3, 5, 8, 13]
        assert done["feedbacks"] == 6
        assert '"sequence": [0, 1, 1' in agent.progress[0]
        code, text = await agent.fail("send_count_goal", goal={"order": 7})
        assert (code, "was aborted" in text) == ("wrong_state", True), text
        assert (await agent.fail("send_count_goal", goal={"order": 101}))[0] == "refused"
        assert rover.goals == ["succeeded", "aborted"]

    ask(scenario)


def test_a_goal_that_takes_too_long_is_cancelled(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        await agent.do("send_count_goal", goal={"order": 1})  # the server has been found
        code, text = await agent.fail("send_count_goal", goal={"order": 90}, timeout_s=0.3)
        assert code == "not_ready"
        assert "did not end within 0.3 s" in text
        assert "the goal was ended (canceled)" in text
        assert rover.goals[-1] == "canceled"

    ask(scenario)


def test_parameters_are_listed_described_read_and_set_within_limits(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        node = {"node": "robot_node"}
        assert (await agent.do("list_parameters", **node))["names"] == ["gain", "label"]
        assert (await agent.do("get_parameters", **node, names=["gain", "label"]))[
            "parameters"
        ] == {
            "gain": 1.5,
            "label": "a",
        }
        described = await agent.do("describe_parameters", **node, names=["gain"])
        assert described["parameters"]["gain"]["type"] == "double"
        assert (await agent.do("set_parameters", **node, parameters={"gain": 2}))["parameters"] == {
            "gain": 2.0
        }
        assert rover.node.get_parameter("gain").value == 2.0
        assert (await agent.fail("set_parameters", **node, parameters={"gain": 11}))[0] == "refused"
        assert (await agent.fail("set_parameters", **node, parameters={"label": 3}))[
            0
        ] == "invalid_input"
        assert (await agent.fail("set_parameters", **node, parameters={"nothing": 3}))[
            0
        ] == "invalid_input"
        for name in (
            "gain\0",
            "gain\0x",
            "\0gain",
            "gain\n",
            "gain ",
            "\uff47ain",
            "gain\u200b",
            "g\u0061\u0301in",
        ):
            assert (await agent.fail("set_parameters", **node, parameters={name: 99}))[
                0
            ] == "invalid_input"
            assert (await agent.fail("get_parameters", **node, names=[name]))[0] == "invalid_input"
        for tool in ("get_parameters", "describe_parameters"):
            assert (await agent.fail(tool, **node, names=["secret"]))[0] == "refused"
        assert (await agent.fail("set_parameters", **node, parameters={"secret": "c"}))[
            0
        ] == "refused"
        assert (await agent.fail("get_parameters", node="other", names=["gain"]))[
            0
        ] == "invalid_input"
        assert rover.node.get_parameter("gain").value == 2.0

    ask(scenario)


def test_what_is_exposed_is_shown_with_what_the_graph_knows_of_it(ask: Ask, rover: Any) -> None:
    async def scenario(agent: Any) -> None:
        await agent.do("publish_speech", message={"data": "x"})
        topics = {(t["robot"], t["name"]): t for t in (await agent.do("list_topics"))["topics"]}
        assert topics["rover", "speech"]["subscribers"] == 1
        assert topics["rover", "light"]["served"] is True
        assert topics["rover", "absent"]["served"] is False
        assert (await agent.do("list_nodes"))["nodes"] == ["/rover/robot_node"]
        described = await agent.do("describe_interface", type="std_srvs/srv/SetBool")
        assert set(described["parts"]) == {"request", "response"}
        assert (
            "geometry_msgs/msg/Twist"
            in (await agent.do("list_interfaces", package="geometry_msgs"))["interfaces"]
        )
        assert (await agent.fail("describe_interface", type="../../etc/passwd"))[
            0
        ] == "invalid_input"

    ask(scenario)


def test_a_topic_of_another_type_is_named(ask: Ask, rover: Any, application: Application) -> None:
    from std_msgs.msg import Bool

    async def scenario(agent: Any) -> None:
        rover.node.create_subscription(Bool, "nobody", lambda message: None, 1)
        assert holds_within(
            lambda: application.supervisor.link.node.count_subscribers("/rover/nobody") == 1
        )
        code, text = await agent.fail("publish_lonely", message={})
        assert code == "configuration"
        assert "carries std_msgs/msg/Bool, it is exposed as std_msgs/msg/Empty" in text

    ask(scenario)
