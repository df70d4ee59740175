"""The MCP clients of public frameworks against our server, each in an environment of its own.

Run by `make test-frameworks`; prints a row for each: list tools, call one, get an image, show the
reason of an error, progress, cancel a call that drives. What drives is judged by the commands that
the wheels receive.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

from check import start_server

from rn_testing.domain import free_ros_domain
from rn_testing.fakes.wheels import CommandedWheels
from rn_testing.waiting import holds_within
from roboneuron.ros.environment import prepare_environment

HERE = Path(__file__).parent
STEPS = ("list", "call", "image", "error", "progress", "cancel")
REVISIONS = ("2024-11-05", "2025-03-26", "2025-06-18", "2025-11-25")
TOKEN = "the-token-of-this-test"
LONGEST_S, REST_S = 300.0, 2.0
CONFIG = """
[[http.tokens]]
name = "client"
role = "admin"
variable = "TEST_TOKEN"
[[expose]]
name = "velocity"
kind = "publish"
topic = "cmd_vel"
type = "geometry_msgs/msg/Twist"
require_subscriber = false
"""


def try_client(arguments: Sequence[str], domain: int) -> dict[str, tuple[bool, str]]:
    """Outcome of each step of a client, whose server is on a ROS domain."""
    python = HERE.parents[1] / f".venv-client-{arguments[0]}" / "bin" / "python"
    wheels = CommandedWheels(domain, "fr3")
    process = subprocess.Popen(
        [str(python), str(HERE / "clients.py"), *arguments],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    said: list[str] = []
    assert process.stdout is not None
    assert process.stderr is not None
    errors = process.stderr
    reading = threading.Thread(target=lambda: said.extend(errors), daemon=True)
    reading.start()
    ending = threading.Timer(LONGEST_S, process.kill)
    ending.start()
    found: dict[str, tuple[bool, str]] = {}
    try:
        for line in process.stdout:
            if line.startswith('{"step"'):
                told = json.loads(line)
                found[told["step"]] = (told["good"], told["said"])
                if told["step"] == "cancel" and told["good"]:
                    # what the wheels are told reaches this process later than the client's answer
                    rests = holds_within(lambda: wheels.speeds[-1:] == [0.0], REST_S)
                    has_driven = any(wheels.speeds)
                    words = f"{told['said']}; the wheels {'rest' if rests else 'TURN'}"
                    found["cancel"] = (has_driven and rests, words)
        process.wait()
        reading.join(5.0)
    finally:
        ending.cancel()
        process.kill()
        process.wait()
        wheels.close()
    last = [line.strip() for line in said if line.strip()][-1:] or ["it said nothing"]
    return found or dict.fromkeys(STEPS, (False, last[0]))


def report(name: str, arguments: Sequence[str], domain: int) -> bool:
    """Try a client, print a line for each step; return True if all passed."""
    found = try_client(arguments, domain)
    for step in STEPS:
        good, said = found.get(step, (False, "not reached"))
        print(f"{name:24} {step:9} {'pass' if good else 'FAIL'}  {said}", flush=True)
    return all(found.get(step, (False, ""))[0] for step in STEPS)


def main() -> int:
    """Try the named clients; status 1 if a step fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="+", help="as in CLIENTS of tools/lanes/environments.py")
    names = parser.parse_args().names
    ours = [sys.executable, "-m", "roboneuron.cli.main"]
    with tempfile.TemporaryDirectory(prefix="roboneuron-frameworks-") as folder:
        prepare_environment(Path(folder) / "ros")
        os.environ |= {"TEST_TOKEN": TOKEN, "ROBONEURON_TOKEN": TOKEN}
        domain = free_ros_domain()
        server, url = start_server(Path(folder), CONFIG, domain)
        try:
            for tool in ("start_robot", "start_perception"):
                subprocess.run([*ours, "call", tool, "--url", url], check=True, capture_output=True)
            rows = [(name, [name, url]) for name in names if name != "mcp"]
            if "mcp" in names:
                rows += [(f"mcp {one} http", ["mcp", url, one]) for one in REVISIONS]
            passed = [report(name, arguments, domain) for name, arguments in rows]
        finally:
            server.send_signal(signal.SIGTERM)
            code = server.wait(60)
        print(f"the server ends on SIGTERM with status {code}")
        if "mcp" in names:  # each with a server and a robot of its own
            serve = [*ours, "serve", "--config", str(Path(folder) / "roboneuron.toml")]
            for one in REVISIONS:
                row = ["mcp", "stdio", one, *serve]
                passed.append(report(f"mcp {one} stdio", row, free_ros_domain()))
    return 0 if all(passed) and code == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
