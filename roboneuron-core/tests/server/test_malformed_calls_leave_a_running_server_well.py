"""Ten thousand malformed calls over MCP to a server process: each is an error, nothing is
published, and the server continues.
"""

from __future__ import annotations

import json
import os
import random
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from rn_testing.waiting import wait_until

pytestmark = [pytest.mark.ros, pytest.mark.timeout(1200)]
AXES = ", ".join(
    f'"{part}.{axis}" = [-0.5, 0.5]' for part in ("linear", "angular") for axis in "xyz"
)
CONFIG = f"""
[[expose]]
name = "velocity"
kind = "publish"
topic = "cmd_vel"
type = "geometry_msgs/msg/Twist"
bounds = {{ {AXES} }}
stop_message = "zero"
[[expose]]
name = "speech"
kind = "publish"
topic = "say"
type = "std_msgs/msg/String"
[[expose]]
name = "picture"
kind = "publish"
topic = "picture"
type = "sensor_msgs/msg/Image"
[[expose]]
name = "joint_trajectory"
kind = "publish"
topic = "joint_trajectory"
type = "trajectory_msgs/msg/JointTrajectory"
[[expose]]
name = "light"
kind = "service"
topic = "light"
type = "std_srvs/srv/SetBool"
[[expose]]
name = "count"
kind = "action"
topic = "count"
type = "test_msgs/action/Fibonacci"
bounds = {{ "order" = [0, 100] }}
[[expose]]
name = "node"
kind = "parameters"
topic = "node"
bounds = {{ "gain" = [0, 10] }}
"""
TWIST = {part: dict.fromkeys("xyz", 0.1) for part in ("linear", "angular")}
POINT = {"positions": [0.1], "velocities": [0.1], "time_from_start": {"sec": 1, "nanosec": 0}}
GOOD: dict[str, dict[str, Any]] = {
    "publish_velocity": {"message": TWIST, "duration_s": 1, "timeout_s": 1, "simulate": False},
    "publish_velocity_sequence": {"steps": [{"message": TWIST, "duration_s": 1}], "times": 2},
    "publish_speech": {"message": {"data": "x"}, "timeout_s": 1},
    "publish_picture": {
        "message": {"height": 1, "width": 1, "data": [1], "is_bigendian": 0},
        "timeout_s": 1,
    },
    "publish_joint_trajectory": {
        "message": {"joint_names": ["slide_x"], "points": [POINT]},
        "timeout_s": 1,
    },
    "call_light": {"request": {"data": True}, "timeout_s": 1},
    "send_count_goal": {"goal": {"order": 3}, "timeout_s": 1, "server_timeout_s": 1},
    "set_parameters": {"node": "node", "parameters": {"gain": 1.0}, "timeout_s": 1},
    "get_parameters": {"node": "node", "names": ["gain"], "timeout_s": 1},
    "read_joint_states": {"count": 1, "timeout_s": 1},
    "move_joints": {"positions": {"slide_x": 0.1}, "duration_s": 1},
    "move_ee": {"dx_m": 0.1, "gripper_open": 0.5, "duration_s": 1},
    "describe_interface": {"type": "std_msgs/msg/Bool"},
    "start_inference": {"backend": "picky", "instruction": "x", "options": {}},
    "set_instruction": {"instruction": "x", "timeout_s": 1},
    "start_robot": {"robot": "gantry", "driver": "fake"},
    "get_camera_image": {"camera": "front"},
}
DEEP: Any = 0
for _ in range(200):
    DEEP = [DEEP]
WRONG: list[Any] = [
    *(
        float("nan"),
        float("inf"),
        float("-inf"),
        1e308,
        -1e308,
        10**400,
        -(10**400),
        2**64,
        -(2**63) - 1,
    ),
    *(
        "x" * 1_000_000,
        "../../etc/passwd",
        "/gantry/cmd_vel",
        "a\x00b",
        "\ud800",
        "{{7*7}}",
        "'; drop",
    ),
    *({"x": 1}, {"": {}}, {"__class__": {}}, [[]], [None], DEEP, ["x"] * 10_000, True),
]
ODD: list[Any] = [
    None,
    0,
    "tools",
    [],
    [1],
    {"name": 1},
    {"arguments": []},
    {"name": "publish_velocity", "arguments": 1},
]
INTERNALS = re.compile(
    r"Traceback|File \"|site-packages|\.py\b|object at "
    r"0x|incident|KeyError|TypeError|/root|/work|/home"
)


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all nested values."""
    if path:
        yield path
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, inner in items:
        yield from leaves(inner, (*path, key))


def replaced(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    """A copy with another value at a path."""
    if not path:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[path[0]] = replaced(copy[path[0]], path[1:], new)
    return copy


def is_right(old: Any, new: Any) -> bool:
    """True if a replacement could be valid: the same kind of text, or a boolean for a boolean."""
    return (isinstance(new, str) and isinstance(old, str) and len(new) < 200_000) or (
        new is True and old in (True, False)
    )


class Wire:
    """JSON-RPC lines to and from a server process."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process
        self._number = 0
        params = {
            "protocolVersion": "2025-06-18",
            "capabilities": {},
            "clientInfo": {"name": "fuzz", "version": "1"},
        }
        self.ask("initialize", params)
        self.send({"jsonrpc": "2.0", "method": "notifications/initialized"})

    def send(self, message: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(message).encode() + b"\n")
        self.process.stdin.flush()

    def read(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the server is gone"
        answer: dict[str, Any] = json.loads(line)
        return answer

    def ask(self, method: str, params: Any) -> dict[str, Any]:
        """The answer; one without an id answers a message that the server cannot parse. A ping
        shows that the server is alive.
        """
        self._number += 2
        self.send({"jsonrpc": "2.0", "id": self._number, "method": method, "params": params})
        self.send({"jsonrpc": "2.0", "id": self._number + 1, "method": "ping"})
        found: dict[str, Any] | None = None
        pinged = False
        while not pinged or found is None:
            answer = self.read()
            pinged = pinged or answer.get("id") == self._number + 1
            if answer.get("id") == self._number or ("error" in answer and answer.get("id") is None):
                found = answer
        return found


@pytest.fixture
def wire(
    serve_command: Callable[..., list[str]], server_environment: dict[str, str], tmp_path: Path
) -> Iterator[Wire]:
    command = serve_command()
    configuration = Path(command[command.index("--config") + 1])
    configuration.write_text(configuration.read_text() + CONFIG)
    with (tmp_path / "server.log").open("wb") as log:
        process = subprocess.Popen(
            command,
            env=server_environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
        )
    try:
        yield Wire(process)
    finally:
        process.kill()
        process.wait(5)
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            with suppress(BrokenPipeError):
                pipe.close()


def malformed(chance: random.Random) -> tuple[str, Any]:
    """Method and parameters of a call that cannot be valid."""
    kind = chance.random()
    name = chance.choice(list(GOOD))
    if kind < 0.05:
        return "tools/call", chance.choice(ODD)
    if kind < 0.1:
        return "tools/call", {
            "name": chance.choice([*map(str, WRONG[:4]), "x" * 10_000, "", "../x"]),
            "arguments": {},
        }
    if kind < 0.25:
        return "tools/call", {
            "name": name,
            "arguments": {**GOOD[name], f"extra_{chance.random()}": chance.choice(WRONG)},
        }
    while True:
        path = chance.choice(list(leaves(GOOD[name])))
        old: Any = GOOD[name]
        for key in path:
            old = old[key]
        new = chance.choice(WRONG)
        if not is_right(old, new):
            return "tools/call", {"name": name, "arguments": replaced(GOOD[name], path, new)}


def throw(wire: Wire, wheels: Any, calls: int) -> None:
    """Send the calls, then check that the server works, has not grown, and that nothing was
    published.
    """
    chance = random.Random(3)
    server = psutil.Process(wire.process.pid)
    unread = 0
    resident = 0
    began_s = time.monotonic()
    for index in range(calls):
        method, params = malformed(chance)
        answer = wire.ask(method, params)
        unread += "error" in answer
        text = json.dumps(answer)
        assert "error" in answer or answer["result"]["isError"], (params, text[:2000])
        assert len(text) < 8000, text[:2000]
        assert not INTERNALS.search(text), (str(params)[:500], text)
        if index == min(500, calls // 2):
            resident = server.memory_info().rss
    took_s = time.monotonic() - began_s
    grown = (server.memory_info().rss - resident) / 2**20
    told = f"{unread} of them no message of MCP; the server grew by {grown:.1f} MiB"
    print(f"{calls} malformed calls in {took_s:.1f} s, {told}")
    assert grown < 100
    assert not wheels.speeds
    answer = wire.ask(
        "tools/call",
        {"name": "publish_velocity", "arguments": {"message": TWIST, "duration_s": 0.1}},
    )
    assert not answer["result"].get("isError"), answer
    wait_until(lambda: len(wheels.speeds) >= 2, 5)
    assert wheels.speeds == [0.1, 0.0]
    with suppress(BrokenPipeError):
        assert wire.process.stdin is not None
        wire.process.stdin.close()
    assert wire.process.wait(20) == 0


def test_some_hundred_malformed_calls_leave_a_running_server_well(wire: Wire, wheels: Any) -> None:
    throw(wire, wheels, 300)


@pytest.mark.slow
def test_ten_thousand_malformed_calls_leave_a_running_server_well(wire: Wire, wheels: Any) -> None:
    throw(wire, wheels, int(os.environ.get("ROBONEURON_FUZZ_CALLS", "10000")))
