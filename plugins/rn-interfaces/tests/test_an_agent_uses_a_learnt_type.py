"""A real server: an agent publishes, reads, calls and sends goals of learnt types within limits;
audit, events and recording hold them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from typing import Any

import anyio
import pytest
import rclpy
from made_packages import WELD, write_package
from mcap.reader import make_reader
from rclpy.action import ActionServer
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from rn_interfaces.finder import PREFIXES
from rn_interfaces.learning import learn
from rn_interfaces.sources import definitions
from rn_interfaces.store import DefinitionStore
from rn_testing.agent import Agent, client_of
from rn_testing.waiting import wait_for_line
from roboneuron.ros.environment import prepare_environment

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]
WAIT_S = 60.0
"""For what another process does, on a machine that does much else."""
CONFIG = """
[robot]
name = "fr3"
[supervisor]
state_directory = "{state}"
[recorder]
topics = ["done"]
[[expose]]
name = "seam"
kind = "publish"
topic = "seam"
type = "weld_msgs/msg/Seam"
moves = false
rate_hz = 100
bounds = {{ "offset" = [-0.5, 0.5] }}
[[expose]]
name = "done"
kind = "read"
topic = "done"
type = "weld_msgs/msg/Path"
[[expose]]
name = "strike"
kind = "service"
topic = "strike"
type = "weld_msgs/srv/Strike"
moves = false
bounds = {{ "seam.offset" = [-0.5, 0.5] }}
[[expose]]
name = "weld"
kind = "action"
topic = "weld"
type = "weld_msgs/action/Weld"
moves = false
bounds = {{ "seam.offset" = [-0.5, 0.5] }}
[events.thresholds.far]
topic = "seam"
type = "weld_msgs/msg/Seam"
field = "offset[0]"
above = 0.05
"""


class Welder:
    """A node that notes seams, reports paths, strikes and welds."""

    def __init__(self) -> None:
        from weld_msgs.action import Weld
        from weld_msgs.msg import Path as Welds
        from weld_msgs.msg import Seam
        from weld_msgs.srv import Strike

        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = Node("welder", namespace="fr3", context=self.context)
        self.seams: list[Seam] = []
        self.node.create_subscription(Seam, "seam", self.seams.append, 10)
        done = self.node.create_publisher(Welds, "done", 10)
        message = Welds(seams=[Seam(tool="mag")], note="漢", mark=b"\x07")
        self.node.create_timer(0.1, lambda: done.publish(message))
        self.node.create_publisher(Welds, "/unused", 10)

        def strike(request: Strike.Request, response: Strike.Response) -> Strike.Response:
            response.success, response.message = request.dry, request.seam.tool
            return response

        def weld(goal: Any) -> Weld.Result:
            goal.publish_feedback(Weld.Feedback(done=0.5))
            goal.succeed()
            return Weld.Result(length=goal.request.seam.offset[0])

        self.node.create_service(Strike, "strike", strike)
        self._welding = ActionServer(self.node, Weld, "weld", weld)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException, InvalidHandle):
            self._executor.spin()

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown(timeout_sec=2.0)
        self._thread.join(2.0)
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def welder(store: DefinitionStore, tmp_path: Path) -> Iterator[Welder]:
    """The robot's node."""
    prepare_environment(tmp_path / "log")
    made = Welder()
    yield made
    made.close()


def test_an_agent_publishes_reads_and_records_a_learnt_type(
    welder: Welder, store: DefinitionStore, tmp_path: Path
) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"))
    environment = {k: v for k, v in os.environ.items() if k != "ROBONEURON_RECORDER"}

    async def scenario() -> None:
        async with client_of(config, environment) as client:
            do = Agent(client).do

            async def until(condition: Callable[[dict[str, Any]], bool]) -> None:
                with anyio.fail_after(WAIT_S):
                    while not condition(await do("list_recordings")):
                        await anyio.sleep(0.05)

            tools = {tool.name: tool for tool in (await client.list_tools()).tools}
            schema = tools["publish_seam"].input_schema["properties"]["message"]
            assert schema["properties"]["offset"]["minItems"] == 3
            assert schema["properties"]["tool"]["maxLength"] == 16
            await until(lambda now: now["recorder"] == "ok")
            await do("start_recording", name="weld")
            await until(lambda _: welder.node.count_subscribers("/fr3/done") == 1)  # the recorder
            for _ in range(3):
                read = await do("read_done", timeout_s=WAIT_S)
            assert read["messages"][0]["seams"][0]["tool"] == "mag"
            assert read["messages"][0]["note"] == "漢"
            with anyio.fail_after(WAIT_S):
                while not welder.seams:  # the server's own events listen too, so it may go first
                    message = {"offset": [0.1, 0.2, 0.3], "tool": "tig"}
                    await do("publish_seam", message=message)
                    await anyio.sleep(0.1)
            refused = await client.call_tool("publish_seam", {"message": {"offset": [0, 0, 9]}})
            assert refused.is_error
            assert "offset" in refused.content[0].text  # type: ignore[union-attr]
            struck = await do(
                "call_strike", request={"seam": {"tool": "mag"}, "dry": True}, timeout_s=WAIT_S
            )
            assert struck["response"] == {"success": True, "message": "mag"}
            goal = {"seam": {"offset": [0.25, 0.0, 0.0]}}
            welded = await do("send_weld_goal", goal=goal, server_timeout_s=WAIT_S)
            assert (welded["status"], welded["result"]) == ("succeeded", {"length": 0.25})
            far = {"seam": {"offset": [9.0, 0.0, 0.0]}}
            for tool, part in (("call_strike", "request"), ("send_weld_goal", "goal")):
                refused = await client.call_tool(tool, {part: far})
                assert refused.is_error
                assert "offset" in refused.content[0].text  # type: ignore[union-attr]
            events = await client.read_resource("roboneuron://events/thresholds")
            assert '"far"' in events.contents[0].text  # type: ignore[union-attr]
            unknown = await do("list_unknown_types")
            assert {"weld_msgs/msg/Path", "weld_msgs/msg/Seam"} <= set(unknown["learnt"])
            assert unknown["unknown"] == []
            await do("stop_recording", outcome="success")

    anyio.run(scenario)
    assert {tuple(seam.offset) for seam in welder.seams} == {(0.1, 0.2, 0.3)}
    audit = (tmp_path / "state" / "audit.jsonl").read_text().splitlines()
    for tool in ("publish_seam", "call_strike", "send_weld_goal"):
        records = [one for one in map(json.loads, audit) if one.get("tool") == tool]
        verdicts = [verdict for verdict, _ in groupby(one["verdict"] for one in records)]
        assert verdicts == ["allowed", "refused"], tool
    files = sorted((tmp_path / "state" / "runs").rglob("*.mcap"))
    schemas: dict[str, str] = {}
    for path in files:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
            assert summary is not None
            schemas |= {one.name: one.data.decode() for one in summary.schemas.values()}
    assert "MSG: weld_msgs/Seam" in schemas["weld_msgs/msg/Path"]
    assert "string<=16 tool" in schemas["weld_msgs/msg/Path"]


OTHER = """
import time
import rclpy
from rclpy.action import ActionServer
from rclpy.node import Node
from rn_interfaces.finder import install

install()
from weld_msgs.action import Weld
from weld_msgs.msg import Path, Seam
from weld_msgs.srv import Strike

rclpy.init()
node = Node("stranger", namespace="fr3")
node.create_publisher(Path, "done", 10)
node.create_subscription(Seam, "seam", lambda message: None, 10)
node.create_service(Strike, "strike", lambda request, response: response)
welding = ActionServer(node, Weld, "weld", lambda goal: Weld.Result())
print("there", flush=True)
rclpy.spin(node)
"""


def test_another_definition_of_the_type_is_refused(store: DefinitionStore, tmp_path: Path) -> None:
    prepare_environment(tmp_path / "log")
    other = {**os.environ, "XDG_DATA_HOME": str(tmp_path / "other")}
    other[PREFIXES] = sys.prefix
    changed = {**WELD, "msg/Seam.msg": WELD["msg/Seam.msg"] + "int32 added\n"}
    folder = write_package(tmp_path / "src", "weld_msgs", changed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(PREFIXES, sys.prefix)  # the other user does not have this one's store
        learn(
            DefinitionStore(tmp_path / "other" / "roboneuron" / "interfaces"), definitions(folder)
        )
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"))

    async def scenario() -> None:
        async with client_of(config, os.environ) as client:
            calls: tuple[tuple[str, dict[str, Any]], ...] = (
                ("read_done", {}),
                ("publish_seam", {"message": {}}),
                ("call_strike", {"request": {}}),
                ("call_strike", {"request": {}, "simulate": True}),
                ("send_weld_goal", {"goal": {"seam": {}}}),
            )
            for tool, arguments in calls:
                text = ""
                with anyio.fail_after(WAIT_S):
                    while "has another definition of weld_msgs/" not in text:  # discovered
                        answer = await client.call_tool(tool, arguments)
                        text = answer.content[0].text  # type: ignore[union-attr]
                        await anyio.sleep(0.1)
                assert answer.is_error
                assert "ros learn graph" in text
            listed = await client.call_tool("list_topics", {})
            topics = (listed.structured_content or {})["topics"]
            problems = {one["name"]: one["problems"] for one in topics}
            for name in ("done", "seam", "strike", "weld"):
                assert "has another definition of weld_msgs/" in problems[name][0]

    with subprocess.Popen(
        [sys.executable, "-c", OTHER], env=other, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            wait_for_line(process.stdout, "there")
            anyio.run(scenario)
        finally:
            _end(process)


def _end(process: subprocess.Popen[str]) -> None:
    """Not killed at once: it would stay on the graph of the next test. rclpy may lose a signal."""
    for _ in range(3):
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(WAIT_S / 3)
            return
    process.kill()
