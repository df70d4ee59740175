"""Trace three paths through the code in a running server, and print the files of each in the order
of their first call.

    python tools/trace_ways.py            # about a minute

It needs ROS, the packages of `make demo` and rn-robot-bases.

The paths are: from a call of `publish_velocity` to its message, from an image to its joint command,
and from the key `control.action_timeout_s` to its use. Every called function of the project is
recorded per process and thread: for the first two paths while a window is open, for the third if it
gets a configuration or a part of it. Periodic code such as the status also appears in a window;
docs/architecture.md separates it from the path.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import anyio
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

from rn_testing.domain import free_ros_domain
from roboneuron.config import default_text

HOOK = """
import json, os, sys, threading, time
folder = os.environ["TRACE_WAYS"]
seen, window, facts = {}, "", {}
def source(name):
    for mark in ("/roboneuron/", "/rn_"):
        place = name.rfind(mark)
        if place >= 0 and "/src/" in name:
            return name[place + 1:].removeprefix("roboneuron/")
    return ""
names = {}
def told(frame):
    for value in list(frame.f_locals.values()):
        kind = type(value)
        if kind.__module__ == "roboneuron.config.models" and kind.__name__ in ("Config", "ControlConfig"):
            return True
        if kind.__name__ == "ModuleSettings":
            facts.setdefault("kind", value.kind)
        if kind.__name__ == "ModuleSettings" or kind.__name__.endswith("Plan"):
            return True
    return False
def hook(frame, event, argument):
    if event != "call":
        return
    code = frame.f_code
    name = names.get(code)
    if name is None:
        name = names[code] = source(code.co_filename)
    if not name or code.co_name.startswith("<"):
        return
    thread = threading.current_thread().name
    if window and (window, thread, name, code.co_qualname) not in seen:
        seen[window, thread, name, code.co_qualname] = time.monotonic_ns()
    if ("key", thread, name, code.co_qualname) not in seen and told(frame):
        seen["key", thread, name, code.co_qualname] = time.monotonic_ns()
def look():
    global window
    while True:
        try:
            window = open(os.path.join(folder, "window")).read()
        except OSError:
            window = ""
        time.sleep(0.02)
        rows = [[at, *key] for key, at in list(seen.items())]
        path = os.path.join(folder, f"{os.getpid()}.json")
        with open(path + ".new", "w") as file:
            json.dump({"words": sys.argv, **facts, "rows": rows}, file)
        os.replace(path + ".new", path)
threading.setprofile(None)
threading.Thread(target=look, daemon=True, name="trace").start()
threading.setprofile(hook)
sys.setprofile(hook)
"""  # noqa: E501


@contextmanager
def window(folder: Path, name: str) -> Iterator[None]:
    """Record every call within the block."""
    (folder / "window").write_text(name)
    time.sleep(0.2)
    yield
    (folder / "window").unlink()
    time.sleep(0.2)


def print_way(folder: Path, way: str, kinds: tuple[str, ...]) -> None:
    """Print the files of a path by process and thread, in the order of their first call, with the
    first called function and the number of other functions called later.
    """
    rows = [
        (kind, row)
        for kind in kinds
        for process, found in read(folder)
        if process == kind
        for row in sorted(found)
        if row[1] == way
    ]
    threads: dict[tuple[str, str], dict[str, list[str]]] = {}
    for kind, (_, _, thread, name, function) in rows:
        threads.setdefault((kind, thread), {}).setdefault(name, []).append(function)
    for (kind, thread), files in threads.items():
        places = [
            f"{name} ({called[0]}{f' +{len(called) - 1}' if called[1:] else ''})"
            for name, called in files.items()
        ]
        print(f"  {kind}, {thread}: {', '.join(places)}")
    functions = {(row[3], row[4]) for _, row in rows}
    names = {name for name, _ in functions}
    packages = {name.rpartition("/")[0] for name in names}
    print(
        f"  {len(functions)} functions in {len(names)} files of {len(packages)} packages, "
        f"{sum(not name.startswith('rn_') for name in names)} of the files in core\n"
    )


def read(folder: Path) -> Iterator[tuple[str, list[list[Any]]]]:
    """Records of each process: "serve" or the kind of its module, and its first calls."""
    for path in sorted(folder.glob("*.json")):
        told = json.loads(path.read_text())
        yield "serve" if "serve" in told["words"] else told.get("kind", ""), told["rows"]


async def trace(
    folder: Path, config: str, ways: dict[str, list[tuple[str, dict[str, Any]]]]
) -> None:
    """Serve a configuration, and make the calls of each path within its window."""
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(HOOK)
    (folder / "roboneuron.toml").write_text(config)
    environment = {
        **os.environ,
        "TRACE_WAYS": str(folder),
        "PYTHONPATH": str(folder),
        "ROS_DOMAIN_ID": str(free_ros_domain()),
        "XDG_STATE_HOME": str(folder / "state"),
    }
    words = [
        "-m",
        "roboneuron.cli.main",
        "serve",
        "--config",
        str(folder / "roboneuron.toml"),
        "--log-level",
        "error",
    ]
    server = StdioServerParameters(command=sys.executable, args=words, env=environment)
    async with Client(stdio_client(server), read_timeout_seconds=120) as client:
        for way, calls in ways.items():
            with window(folder, way):
                for tool, arguments in calls:
                    answer = await client.call_tool(tool, arguments)
                    assert not answer.is_error, answer.content
                await anyio.sleep(2.0)
        await client.call_tool("stop_all", {})


def main() -> None:
    """Trace and print the three paths."""
    twist = {"linear": {"x": 0.1, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}}
    start: list[tuple[str, dict[str, Any]]] = [
        (f"start_{kind}", {}) for kind in ("robot", "perception", "control")
    ]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as root:
        base, arm = Path(root) / "base", Path(root) / "arm"
        publish = ("publish_velocity", {"message": twist, "duration_s": 0.3})
        anyio.run(
            trace,
            base,
            '[robot]\nname = "diffdrive"\n',
            {"start": start[:1], "warm": [publish], "a": [publish]},
        )
        begin = ("start_inference", {"instruction": "pick up the red cube"})
        anyio.run(trace, arm, default_text(), {"start": [*start, begin], "b": []})
        print("publish_velocity, from the call to the message on cmd_vel")
        print_way(base, "a", ("serve",))
        print("an image to a joint command")
        print_way(arm, "b", ("perception", "inference", "control"))
        print("control.action_timeout_s, from the file to its use")
        print_way(arm, "key", ("serve", "control"))


if __name__ == "__main__":
    main()
