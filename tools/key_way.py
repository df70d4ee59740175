"""The way of a key of the configuration, `control.action_timeout_s`, from its file to its use in
the control module, in this process: the server is real and joins no graph, the process that it
spawns only keeps its line of settings, from which the module is then made here.

The way is that of the stations below, the calls in which the value, or what holds it, is parsed,
kept, sent or used, and of the functions that were running then, which have handed it on.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import threading
import time
from argparse import Namespace
from contextlib import nullcontext, suppress
from pathlib import Path
from types import FrameType
from typing import Any
from unittest.mock import patch

from publish_way import Unjoined
from way_count import Call, Way, file_of

from rn_testing.domain import free_ros_domain
from roboneuron.cli import serve
from roboneuron.config import default_text
from roboneuron.ros.environment import prepare_environment
from roboneuron.server.app import Application

STATIONS = (
    "parse_tables",
    "ClosedLoop.__init__",
    "plan_control",
    "Supervisor.start",
    "Supervisor._spawn",
    "spawn",
    "ModuleHost.__init__",
    "HoldingModule.__init__",
)
"""Where the value is parsed, kept by the server, planned with, put into the settings of a process,
handed to the thread that starts processes, sent to the process, kept by its node, and used.
"""
WAIT_S = 20.0


class _StartedError(Exception):
    """Ends the server once the module was started."""


class StackRecorder:
    """Notes the running functions of the project at the newest call of each station.

    Attributes:
        stacks: by station, the outermost function first.
    """

    def __init__(self) -> None:
        self.stacks: dict[str, list[Call]] = {}

    def note(self, frame: FrameType, event: str, argument: object) -> None:
        """The profile function."""
        station = frame.f_code.co_qualname
        if event != "call" or station not in STATIONS:
            return
        stack: list[Call] = []
        at: FrameType | None = frame
        while at is not None:
            if file := file_of(at.f_code):
                stack.append(Call(time.monotonic_ns(), "", "", file, at.f_code.co_qualname))
            at = at.f_back
        self.stacks[station] = stack[::-1]


def serve_until_started(folder: Path) -> str:
    """Serve the default configuration until the control module is started; return its line of
    settings.
    """
    line = folder / "line"
    config = folder / "roboneuron.toml"
    config.write_text(f'{default_text()}\n[supervisor]\nstate_directory = "{folder}"\n')

    def start(application: Application, wire: tuple[int, int]) -> None:
        supervisor = application.supervisor
        supervisor.connection = Unjoined(supervisor.receive, supervisor.log_directory)
        supervisor._command = lambda python: ["/bin/sh", "-c", f"head -n 1 > {line}"]
        with suppress(Exception):  # without a graph the start ends after the process was spawned
            application.loop.start("control")
        raise _StartedError

    arguments = Namespace(
        config=config, log_level="error", transport=None, host=None, port=None, switches=None
    )
    with (
        patch.object(Application, "listen", start),
        patch.object(serve, "divert_standard_streams", lambda: (0, 1)),
        suppress(_StartedError),
    ):
        serve.run(arguments)
    signal.setitimer(signal.ITIMER_REAL, 0)  # of `Host.end_soon`
    deadline_s = time.monotonic() + WAIT_S
    while not (line.is_file() and line.read_text().endswith("\n")):
        if time.monotonic() > deadline_s:
            raise SystemExit("No settings were sent.")
        time.sleep(0.01)
    return line.read_text()


def make_module(line: str) -> None:
    """Make the module of that line as its process does, up to `configure`."""
    from roboneuron.modules import module

    def configure(node: Any, signals: object) -> None:
        node._configure()

    with (
        patch.object(module, "claim", lambda *arguments: nullcontext()),
        patch.object(module, "_spin", configure),
        patch.object(module.ModuleNode, "watch_parent", lambda node, on_end: None),
    ):
        module.run(line)


def trace_key() -> Way:
    """The functions that hand on the value, in order.

    Raises:
        AssertionError: a station was not reached.
    """
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    recorder = StackRecorder()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        prepare_environment(Path(name))
        threading.setprofile(recorder.note)
        sys.setprofile(recorder.note)
        try:
            make_module(serve_until_started(Path(name)))
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    missing = [station for station in STATIONS if station not in recorder.stacks]
    assert not missing, missing
    calls = {
        (call.file, call.function): call
        for station in STATIONS
        for call in recorder.stacks[station]
    }
    return Way(list(calls.values()))


def main() -> None:
    """Print the way, or with --json its counts."""
    way = trace_key()
    if "--json" in sys.argv:
        print(json.dumps({"functions": way.functions, "files": len(way.files)}))
        return
    print(f"control.action_timeout_s: {way.functions} functions, {len(way.files)} files")
    print(way.listing())


if __name__ == "__main__":
    main()
