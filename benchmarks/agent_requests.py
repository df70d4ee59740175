"""Fourteen requests of people, each with the agent's calls and the conditions that must hold
afterwards.
"""

from __future__ import annotations

import json
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

import anyio
from mcp import Client, types

NEAR_M = 0.03


@dataclass
class Seen:
    """Results of a request: its checks, and the size of the answers that an agent reads in
    bytes.
    """

    checks: list[tuple[str, bool]] = field(default_factory=list)
    size: int = 0
    took_s: float = 0.0

    @property
    def score(self) -> int:
        return sum(is_met for _, is_met in self.checks)


class Agent:
    """A client that calls listed tools. The bytes that it reads are counted, but not those of the
    simulator's state.
    """

    def __init__(self, client: Client, tools: dict[str, types.Tool]) -> None:
        self.tools = tools
        self.seen = Seen()
        self._client = client

    def check(self, what: str, is_met: bool) -> None:
        self.seen.checks.append((what, bool(is_met)))

    def has(self, tool: str, *arguments: str) -> bool:
        """True if a tool with these arguments is listed."""
        found = self.tools.get(tool)
        return found is not None and set(arguments) <= set(found.input_schema.get("properties", {}))

    async def do(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """The structured answer; for an error its text, as "error"."""
        if tool not in self.tools:
            return {"error": f"There is no tool {tool}."}
        answer = await self._client.call_tool(tool, arguments)
        # The structured content repeats the text; clients show an agent one of the two.
        self.seen.size += sum(
            len(part.model_dump_json(by_alias=True, exclude_none=True)) for part in answer.content
        )
        if answer.is_error:
            return {"error": " ".join(getattr(part, "text", "") for part in answer.content)}
        return {**(answer.structured_content or {}), "images": _images(answer)}

    async def truth(self) -> dict[str, Any]:
        """The simulator's cubes; not counted."""
        answer = await self._client.call_tool("get_status", {})
        modules = (answer.structured_content or {}).get("modules", [])
        detail: dict[str, Any] = next(
            (m.get("detail", {}) for m in modules if m["module"] == "robot"), {}
        )
        found: dict[str, Any] = json.loads(detail.get("cubes", "{}"))
        return found


def _images(answer: types.CallToolResult) -> int:
    return sum(part.type == "image" for part in answer.content)


def worked(answer: dict[str, Any]) -> bool:
    return not isinstance(answer.get("error"), str)  # a number is a motion's remaining distance


async def look(agent: Agent) -> None:
    """What do you see?"""
    started = await agent.do("start_all")
    answer = await agent.do("get_camera_image")
    agent.check("one call starts everything", worked(started))
    agent.check("a tool shows an image", agent.has("get_camera_image"))
    agent.check("it works", worked(answer))
    agent.check("it is a picture", answer.get("images", 0) == 1)
    agent.check("its answers are short", agent.seen.size < 400_000)


async def _pick(agent: Agent, colour: str) -> dict[str, Any]:
    return await agent.do("run_task", instruction=f"pick up the {colour} cube", max_s=90.0)


async def pick(agent: Agent) -> None:
    """Pick up the red cube."""
    answer = await _pick(agent, "red")
    agent.check("a tool carries out a task", agent.has("run_task", "instruction"))
    agent.check("it works", worked(answer))
    agent.check("the outcome is one word", answer.get("outcome") in ("succeeded", "unclear"))
    agent.check("the answer says why", bool(answer.get("reason")))
    agent.check("the red cube is up", (await agent.truth())["red"]["lifted_m"] > 0.1)


async def place(agent: Agent) -> None:
    """Put it 15 cm to the left."""
    there = (await agent.truth())["red"]["position_m"]
    await agent.do("stop_inference")
    answer = await agent.do("place", dy_m=0.15)
    cube = (await agent.truth())["red"]
    off_m = abs(cube["position_m"][1] - there[1] - 0.15)
    agent.check("one tool does it", agent.has("place", "dy_m"))
    agent.check("it works", worked(answer))
    agent.check("the answer says that the hand is empty", answer.get("holding") is False)
    agent.check("the cube stands on the table", abs(cube["lifted_m"]) < 0.01)
    agent.check("15 cm to the left", off_m < NEAR_M)


async def move_up(agent: Agent) -> None:
    """Move up by 2 cm."""
    answer = await agent.do("move_ee", dz_m=0.02)
    agent.check("a tool moves the hand", agent.has("move_ee", "dz_m"))
    agent.check("it works", worked(answer))
    agent.check("2 cm", abs(answer.get("moved", {}).get("dz_m", 0.0) - 0.02) < 0.004)
    agent.check("the answer says where", len(answer.get("position_m", [])) == 3)
    agent.check("and what the hand holds", "holding" in answer)


async def go_home(agent: Agent) -> None:
    """Go home."""
    answer = await agent.do("move_to", name="home")
    agent.check("a tool goes to places", agent.has("move_to", "name"))
    agent.check("home is among them", "home" in json.dumps(agent.tools["move_to"].input_schema))
    agent.check("it works", worked(answer))
    agent.check("it is there", answer.get("error", 1.0) < 0.01)
    agent.check("within 15 s", answer.get("took_s", 99.0) < 15.0)


async def two_cubes(agent: Agent) -> None:
    """Pick up the green cube, put it down, then the blue one."""
    first = await _pick(agent, "green")
    up = (await agent.truth())["green"]["lifted_m"] > 0.1
    await agent.do("stop_inference")
    down = await agent.do("place", dx_m=0.0)
    await agent.do("start_inference")
    second = await _pick(agent, "blue")
    agent.check("both tasks work", worked(first) and worked(second))
    agent.check("the green cube was up", up)
    agent.check(
        "it was put down", worked(down) and abs((await agent.truth())["green"]["lifted_m"]) < 0.02
    )
    agent.check("the blue cube is up", (await agent.truth())["blue"]["lifted_m"] > 0.1)
    agent.check("outcomes are told", {"outcome"} <= first.keys() & second.keys())


async def stop(agent: Agent) -> None:
    """Stop."""
    answer = await agent.do("stop_inference")
    status = await agent.do("get_status")
    agent.check("a tool stops", agent.has("stop_inference"))
    agent.check("it works", worked(answer))
    agent.check("within 3 s", answer.get("took_s", 99.0) < 3.0)
    agent.check("nothing is latched", status.get("emergency_stop") is False)
    agent.check("what is held stays held", (await agent.truth())["blue"]["lifted_m"] > 0.1)


async def what_happened(agent: Agent) -> None:
    """What happened?"""
    incidents = await agent.do("list_incidents", entries=3)
    logs = await agent.do("get_logs", module="robot", entries=20)
    agent.check("incidents are listed", agent.has("list_incidents", "entries"))
    agent.check("that works", worked(incidents))
    agent.check("logs are there", agent.has("get_logs"))
    agent.check("that works, too", worked(logs))
    agent.check("in less than 8 kB", agent.seen.size < 8000)


async def who(agent: Agent) -> None:
    """Which robot is that, and who moves it?"""
    status = await agent.do("get_status")
    robots = await agent.do("list_robots")
    robot: dict[str, Any] = next(
        (m for m in status.get("modules", []) if m["module"] == "robot"), {}
    )
    agent.check("the status names the robot", "fr3" in json.dumps(robot.get("started_with", {})))
    agent.check("and its driver", "simulated" in json.dumps(robot))
    agent.check("the status says what runs", bool(status.get("modules")))
    agent.check("robots are listed", worked(robots))
    agent.check("in less than 12 kB", agent.seen.size < 12_000)


async def switch(agent: Agent) -> None:
    """Use another model."""
    listed = await agent.do("list_backends")
    await agent.do("start_inference")
    answer = await agent.do("switch_inference", backend="servo")
    agent.check("models are listed", worked(listed) and "servo" in json.dumps(listed))
    agent.check("a tool switches", agent.has("switch_inference", "backend"))
    agent.check("it works", worked(answer))
    agent.check("the answer says what runs", "servo" in json.dumps(answer))
    agent.check("nothing was dropped", (await agent.truth())["blue"]["lifted_m"] > 0.1)
    await agent.do("stop_inference")


async def record(agent: Agent, record_s: float) -> None:
    """Record the next minute."""
    answer = await agent.do("start_recording", name="minute", duration_s=record_s)
    agent.check("a tool records for a time", agent.has("start_recording", "duration_s"))
    agent.check("it works", worked(answer))
    agent.check("the answer says where", bool(answer.get("directory")))
    listed: dict[str, Any] = {}
    deadline_s = time.monotonic() + record_s + 30.0
    while time.monotonic() < deadline_s:
        listed = await agent.do("list_recordings", entries=1)
        states = [run["state"] for run in listed.get("runs", []) if run["id"] == answer.get("id")]
        if not worked(listed) or states == ["finished"]:
            break
        await anyio.sleep(1.0)
    runs = [run for run in listed.get("runs", []) if run["id"] == answer.get("id")]
    agent.check("it ends by itself", bool(runs) and runs[0]["state"] == "finished")
    agent.check("something is in it", bool(runs) and runs[0]["size_bytes"] > 10_000)


async def slower(agent: Agent) -> None:
    """Go slower from now on."""
    answer = await agent.do("tighten_limits", max_speed_m_s=0.05)
    moved = await agent.do("move_ee", dz_m=0.05)
    speed = 0.05 / max(1e-3, moved.get("duration_s", 1e-3))
    agent.check("a tool tightens limits", agent.has("tighten_limits", "max_speed_m_s"))
    agent.check("it works", worked(answer))
    agent.check("moves still work", worked(moved))
    agent.check("they are slower", speed <= 0.05)
    agent.check("the status shows it", bool((await agent.do("get_status")).get("tightened_limits")))


async def not_left(agent: Agent) -> None:
    """Never go into the left half."""
    await agent.do("move_to", name="home")
    right = await agent.do("move_ee", dy_m=-0.05)
    answer = await agent.do("tighten_limits", y_max_m=0.0)
    refused = await agent.do("move_ee", dy_m=0.12)
    other = await agent.do("move_joints", positions={"fr3_joint1": 0.6})
    agent.check("a tool keeps it out", agent.has("tighten_limits", "y_max_m"))
    agent.check("it works", worked(answer))
    agent.check("the right half is free", worked(right))
    agent.check("the left half is refused to the hand", "workspace" in refused.get("error", ""))
    agent.check("and to joints", "workspace" in other.get("error", ""))


async def release(agent: Agent) -> None:
    """Emergency stop; then go on."""
    pressed = await agent.do("emergency_stop", reason="a person asked")
    refused = await agent.do("move_ee", dz_m=0.02)
    released = await agent.do("reset_emergency_stop")
    before = await agent.do("move_ee", dz_m=-0.02, simulate=True)
    agent.check("it stops", pressed.get("latched") is True)
    agent.check("nothing moves then, and the reason is told", "latched" in refused.get("error", ""))
    agent.check("a person releases it", released.get("latched") is False)
    agent.check("it can move again", before.get("allowed") is True)
    agent.check(
        "the answer says that nothing moves by itself", "Nothing moves" in released.get("note", "")
    )


Request = Callable[[Agent], Awaitable[None]]


def requests(record_s: float) -> list[tuple[str, Request]]:
    """All fourteen, in the order of the conversation."""

    async def record_for(agent: Agent) -> None:
        await record(agent, record_s)

    record_for.__doc__ = record.__doc__
    listed: list[Request] = [
        look,
        pick,
        place,
        move_up,
        go_home,
        two_cubes,
        stop,
        what_happened,
        who,
        switch,
    ]
    listed += [record_for, slower, not_left, release]
    return [(" ".join((request.__doc__ or "").split()), request) for request in listed]
