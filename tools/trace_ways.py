"""Trace the way of an image to a joint command through running modules.

    python tools/trace_ways.py    # needs ROS and the packages of `make demo`; at most five minutes

`publish_way.py` and `key_way.py` trace a call and a key, without ROS. Here the default
configuration is served and started, and every function of the project that a module calls is noted
once, until control has acted on an action. What counts is on the threads that carry the image,
below callbacks that do: timers and watches that run beside are left out (`BESIDE`).
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import anyio
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client
from way_count import Call, Way

from rn_testing.domain import free_ros_domain
from roboneuron.config import default_text

RUN_S = 300.0
CALL_S = 120.0
WINDOW_S = 2.0
END = "MotionLimiter.limit"
"""The last stage of the way, which control reaches only with an action."""
CARRIERS = {"perception": "perception", "inference": "inference", "control": "MainThread"}
"""By module the thread that carries the image, or what was made of it."""
BESIDE = frozenset(
    {
        "ModuleNode._on_loop",
        "HoldingModule._watch",
        "Signals.take_stop",
        "LeadInControl._look",
        "ControlModule._on_joint_state",
        "_count_listeners.<locals>.look",
    }
)
"""Callbacks of timers and other topics on those threads."""
HOOK = """
import json, os, sys, threading, time
from dataclasses import asdict
from way_count import Recorder

class Once(Recorder):
    def keep(self, call):
        seen.setdefault((call.thread, call.root, call.file, call.function), call)

seen, recorder = {}, Once()
folder = os.environ["TRACE_WAYS"]

def look():
    was_on = False
    while True:
        recorder.is_on = os.path.exists(os.path.join(folder, "window"))
        if was_on and not recorder.is_on:
            path = os.path.join(folder, f"{os.getpid()}.json")
            with open(path + ".new", "w") as file:
                json.dump([asdict(call) for call in list(seen.values())], file)
            os.replace(path + ".new", path)
        was_on = recorder.is_on
        time.sleep(0.02)

if "roboneuron.modules" in sys.orig_argv:
    threading.Thread(target=look, daemon=True, name="trace").start()
    recorder.install()
"""


async def trace(folder: Path) -> None:
    """Serve the default configuration, start it, and note the calls of a window.

    Raises:
        TimeoutError: it did not end in time.
    """
    (folder / "sitecustomize.py").write_text(HOOK)
    (folder / "roboneuron.toml").write_text(default_text())
    environment = {
        **os.environ,
        "TRACE_WAYS": str(folder),
        "PYTHONPATH": os.pathsep.join(
            [str(folder), str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
        ),
        "ROS_DOMAIN_ID": str(free_ros_domain()),
        "XDG_STATE_HOME": str(folder / "state"),
    }
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(folder / "roboneuron.toml")]
    words += ["--log-level", "error"]
    server = StdioServerParameters(command=sys.executable, args=words, env=environment)
    starts: list[tuple[str, dict[str, Any]]] = [
        (f"start_{kind}", {}) for kind in ("robot", "perception", "control")
    ]
    starts.append(("start_inference", {"instruction": "pick up the red cube"}))
    with anyio.fail_after(RUN_S):
        async with Client(stdio_client(server), read_timeout_seconds=CALL_S) as client:
            for tool, arguments in starts:
                answer = await client.call_tool(tool, arguments)
                assert not answer.is_error, answer.content
            while not is_complete(folder):
                for path in folder.glob("*.json"):
                    path.unlink()
                (folder / "window").touch()
                await anyio.sleep(WINDOW_S)
                (folder / "window").unlink()
                while len(list(folder.glob("*.json"))) < len(starts):
                    await anyio.sleep(0.05)
            await client.call_tool("stop_all", {})


def is_complete(folder: Path) -> bool:
    """Whether control was seen to act on an action; on a busy machine that takes several
    windows.
    """
    return any(END in path.read_text() for path in folder.glob("*.json"))


def read(folder: Path) -> dict[str, list[Call]]:
    """The calls on the carrying thread of each module, in the order of their first occurrence."""
    found: dict[str, list[Call]] = {}
    for path in sorted(folder.glob("*.json")):
        calls = [Call(**call) for call in json.loads(path.read_text())]
        files = {call.file for call in calls}
        for kind, thread in CARRIERS.items():
            if f"roboneuron/modules/{kind}/module.py" in files:
                found[kind] = sorted(
                    (c for c in calls if c.thread == thread and c.root not in BESIDE),
                    key=lambda call: call.at_ns,
                )
    assert found.keys() == CARRIERS.keys(), found.keys()
    return found


def main() -> None:
    """Trace and print the way."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        anyio.run(trace, Path(name))
        ways = read(Path(name))
    way = Way([call for kind in CARRIERS for call in ways[kind]])
    print(f"an image to a joint command: {way.functions} functions, {len(way.files)} files")
    for kind in CARRIERS:
        part = Way(ways[kind])
        print(f"  {kind}: {part.functions} functions, {', '.join(part.files)}")


if __name__ == "__main__":
    main()
