"""The MCP clients of public frameworks against our server, each in an environment of its own.

Run by `make test-frameworks`; prints a row for each: list tools, call one, get an image, show the
reason of an error, progress, cancel a call that drives. `tests/interop/clients` has their scripts.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from check import start_server

HERE = Path(__file__).parent
STEPS = ("list", "call", "image", "error", "progress", "cancel")
REVISIONS = ("2024-11-05", "2025-03-26", "2025-06-18", "2025-11-25")
TOKEN = "the-token-of-this-test"
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


def try_client(
    arguments: Sequence[str], environment: dict[str, str]
) -> dict[str, tuple[bool, str]]:
    """Outcome of each step of a client's script."""
    name, *rest = arguments
    python = HERE.parents[1] / f".venv-client-{name}" / "bin" / "python"
    command = [str(python), str(HERE / "clients" / f"{name}_client.py"), *rest]
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=300, check=False
        )
    except subprocess.TimeoutExpired:
        return dict.fromkeys(STEPS, (False, "not done within 300 s"))
    found = {}
    for line in done.stdout.splitlines():
        if line.startswith('{"step"'):
            told = json.loads(line)
            found[told["step"]] = (told["good"], told["said"])
    last = done.stderr.strip().splitlines()[-1:] or ["it said nothing"]
    return found or dict.fromkeys(STEPS, (False, last[0]))


def report(name: str, arguments: Sequence[str], environment: dict[str, str]) -> bool:
    """Try a client, print a line for each step; return True if all passed."""
    found = try_client(arguments, environment)
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
        os.environ["TEST_TOKEN"] = TOKEN
        environment = {**os.environ, "ROBONEURON_TOKEN": TOKEN}
        server, url = start_server(Path(folder), CONFIG)
        try:
            for tool in ("start_robot", "start_perception"):
                call = [*ours, "call", tool, "--url", url]
                subprocess.run(call, env=environment, check=True, capture_output=True)
            rows = [(name, [name, url]) for name in names if name != "mcp"]
            if "mcp" in names:
                rows += [(f"mcp {one} http", ["mcp", url, one]) for one in REVISIONS]
            passed = [report(name, arguments, environment) for name, arguments in rows]
        finally:
            server.send_signal(signal.SIGTERM)
            code = server.wait(60)
        print(f"the server ends on SIGTERM with status {code}")
    return 0 if all(passed) and code == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
