"""A server with its agent, and foreign processes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest

from rn_testing.waiting import wait_for_line, wait_until

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
KILTED = ROOT / ".venv-kilted"
SETUP = KILTED / "workspace" / "install" / "setup.bash"
CYCLONE = ROOT / ".venv-cyclone"
IS_READY = SETUP.is_file() and (CYCLONE / ".ready").is_file()
MARKS = [
    pytest.mark.ros,
    pytest.mark.peers,
    pytest.mark.timeout(300),
    pytest.mark.skipif(
        not IS_READY, reason="`make test-peers` sets up .venv-kilted and .venv-cyclone"
    ),
]
WAIT_S = 60.0
"""Time limit for other processes, on a busy machine."""
LOOPBACK = """
<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer Address="localhost"/></Peers></Discovery>
</Domain></CycloneDDS>
"""


@dataclass
class Server:
    """`roboneuron serve` and an agent."""

    domain: int
    config: Path
    environment: dict[str, str]
    call: Callable[[str, dict[str, Any]], Any]
    process: psutil.Process

    def do(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """The result of a call that must succeed."""
        answer = self.call(tool, arguments)
        assert not answer.is_error, answer.content
        return dict(answer.structured_content or {})

    def refusal(self, tool: str, **arguments: Any) -> str:
        """The text of a call that must fail."""
        answer = self.call(tool, arguments)
        assert answer.is_error, answer.structured_content
        return str(answer.content[0].text)

    def problems(self, name: str) -> list[str]:
        """Problems of an endpoint in list_topics."""
        topics = self.do("list_topics")["topics"]
        return list(next(one["problems"] for one in topics if one["name"] == name))

    def doctor(self) -> str:
        """Output of `roboneuron doctor`."""
        command = [sys.executable, "-m", "roboneuron.cli.main", "doctor", "--config"]
        ended = subprocess.run(
            [*command, str(self.config)],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=180,
            check=False,
        )
        return ended.stdout + ended.stderr


@contextmanager
def running(command: list[str], environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """Run a foreign process until its standard input is closed."""
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        try:
            wait_for_line(process.stdout, "there")
            yield process
        finally:
            process.stdin.close()
            try:
                process.wait(WAIT_S)
            except subprocess.TimeoutExpired:
                process.kill()


def cyclone(server: Server, program: str) -> tuple[list[str], dict[str, str]]:
    """Command line and environment of a program of Cyclone DDS."""
    command = [str(CYCLONE / "bin" / "python"), str(HERE / program), str(server.domain)]
    return command, {"CYCLONEDDS_URI": LOOPBACK, "PATH": os.environ["PATH"]}


def kilted(server: Server) -> tuple[list[str], dict[str, str]]:
    """Command line and environment of the nodes of Kilted."""
    of_ros = re.compile("ROS|AMENT|FAST|ROBONEURON|_ROS|LD_LIBRARY|PYTHONPATH")
    shell = {name: value for name, value in os.environ.items() if not of_ros.match(name)}
    words = [str(KILTED / "bin" / "python"), str(HERE / "kilted_node.py")]
    return ["bash", "-c", '. "$0" && exec "$@"', str(SETUP), *words], {
        **shell,
        "ROS_DOMAIN_ID": str(server.domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
    }


def until(look: Callable[[], Any]) -> Any:
    """Poll for the first true value, because discovery takes time."""
    found: list[Any] = []

    def seen() -> bool:
        found[:] = [look()]
        return bool(found[0])

    wait_until(seen, WAIT_S, poll_s=0.1)
    return found[0]
