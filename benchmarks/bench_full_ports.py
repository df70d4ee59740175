"""Response time of an authenticated stop while a port of the server is flooded; on loopback only.

    python benchmarks/bench_full_ports.py                    # every port; about three minutes
    python benchmarks/bench_full_ports.py --ports http view --rate 20000 --requests 700

A server with `ulimit -n 1024`, MCP over HTTP with tokens, metrics and the live view. One port after
the other gets 1,000 silent connections, then 6,000 connects a second (--rate), and MCP and the view
then so many requests at once (--requests), again and again, from separate processes. Meanwhile a
client with a token repeatedly opens a connection and a session and calls `emergency_stop`, and for
the view's port a page presses its stop; it is released in between. The shared model's port is a
Unix socket of a separate process: it gets the same while the server's stop is measured.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any

from rn_testing.domain import free_ros_domain
from roboneuron.estop import ESTOP_FILE, EmergencyStopLatch
from roboneuron.gate.audit import AuditLog

TOKEN = "a-token-of-this-benchmark"
FLOOD_TOKEN = "a-token-of-the-requests"
CONFIG = """
[server]
transport = "http"
[http]
port = 0
[[http.tokens]]
name = "bench"
role = "viewer"
variable = "BENCH_TOKEN"
[[http.tokens]]
name = "flood"
role = "viewer"
variable = "BENCH_FLOOD"
[robot]
name = "fr3"
driver = "simulated"
[supervisor]
state_directory = "{state}"
[metrics]
prometheus = true
port = 0
[view]
enabled = true
port = 0
[plugins.shared]
backend = "servo"
stateless = true
directory = "{state}/model"
"""
HANDLES = 1024
IDLE, RATE, REQUESTS = 1000, 6000, 300
LIMIT_S = 0.5
WORDS = {
    "idle": "held",
    "connects": "a second",
    "requests": "requests at once",
    "calls": "calls at once",
}
START_S = 120.0
FLOOD = """
import resource, signal, socket, sys, time
kind, family, address, number, seconds = sys.argv[1:]
family_name = family
address = address if family == "unix" else ("127.0.0.1", int(address))
family = socket.AF_UNIX if family == "unix" else socket.AF_INET
number, end = int(number), time.monotonic() + float(seconds)
resource.setrlimit(resource.RLIMIT_NOFILE, (min(8192, resource.getrlimit(resource.RLIMIT_NOFILE)[1]),) * 2)

def connect():
    made = socket.socket(family)
    made.settimeout(1.0)
    try:
        made.connect(address)
    except OSError:
        pass
    return made

if kind in ("requests", "calls"):
    import os
    token = os.environ.get("BENCH_FLOOD", "")
    line = chr(13) + chr(10)
    body = '{"jsonrpc":"2.0","id":1,"method":"initialize","params":{"protocolVersion":"2025-06-18",'
    body += '"capabilities":{},"clientInfo":{"name":"viewer","version":"1"}}}'
    named = []
    if kind == "calls":
        named = ["MCP-Protocol-Version: 2026-07-28", "Mcp-Method: tools/call", "Mcp-Name: get_status"]
        body = '{"jsonrpc":"2.0","id":1,"method":"tools/call","params":{"name":"get_status","arguments":{},'
        body += '"_meta":{"io.modelcontextprotocol/protocolVersion":"2026-07-28",'
        body += '"io.modelcontextprotocol/clientCapabilities":{}}}}'
    mcp = ["POST /mcp HTTP/1.1", "Host: 127.0.0.1", *named, "Authorization: Bearer " + token,
           "Accept: application/json, text/event-stream", "Content-Type: application/json",
           "Connection: close", f"Content-Length: {len(body)}", "", body]
    page = ["GET / HTTP/1.1", "Host: 127.0.0.1", "Connection: close", "", ""]
    said = line.join(mcp if family_name == "http" else page).encode()
    print("begun", flush=True)
    while time.monotonic() < end:
        held = [connect() for _ in range(number)]
        for one in held:
            try:
                one.sendall(said)
            except OSError:
                pass
        for one in held:
            try:
                while one.recv(65536) and time.monotonic() < end:
                    pass
            except OSError:
                pass
            one.close()
elif kind == "idle":
    held = [connect() for _ in range(number)]
    print("begun", flush=True)
    while time.monotonic() < end:
        time.sleep(0.1)
else:
    print("begun", flush=True)
    begun, made = time.monotonic(), 0
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        while (now := time.monotonic()) < end:
            due = int((now - begun) * number) - made
            for _ in range(min(due, 200)):
                connect().close()
            made += min(due, 200)
            if due <= 0:
                time.sleep(0.001)
    except KeyboardInterrupt:
        pass
    print(made / (time.monotonic() - begun), flush=True)
"""  # noqa: E501
"""Program that floods a port: kind, family, address, number of connections or of connects a second,
time [s].
"""


@contextmanager
def running(state: Path) -> Iterator[dict[str, tuple[str, str]]]:
    """A server with few handles; the family and address of each of its ports."""
    config, log = state / "roboneuron.toml", state / "server.log"
    config.write_text(CONFIG.format(state=state), encoding="utf-8")
    environment = {
        **os.environ,
        "BENCH_TOKEN": TOKEN,
        "BENCH_FLOOD": FLOOD_TOKEN,
        "ROS_DOMAIN_ID": str(free_ros_domain()),
    }
    command = [sys.executable, "-m", "roboneuron.cli.main"]

    def few_handles() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (HANDLES, HANDLES))

    with log.open("w") as output:
        started = [*command, "serve", "--config", str(config)]
        server = subprocess.Popen(started, env=environment, stderr=output, preexec_fn=few_handles)
        model = subprocess.Popen(
            [*command, "policy", "share", "--config", str(config)],
            env=environment,
            stderr=subprocess.DEVNULL,
            preexec_fn=few_handles,
        )
        try:
            ports = {
                name: ("tcp", wait_for(log, pattern))
                for name, pattern in (
                    ("http", r"serves MCP on http://127.0.0.1:(\d+)"),
                    ("metrics", r"Metrics are at http://127.0.0.1:(\d+)"),
                    ("view", r"live view is at http://127.0.0.1:(\d+)"),
                )
            }
            deadline_s = time.monotonic() + START_S
            while not (sockets := list((state / "model").glob("*.sock"))):
                if model.poll() is not None or time.monotonic() > deadline_s:
                    raise SystemExit("The server of the shared model did not start.")
                time.sleep(0.05)
            yield {**ports, "shared-model": ("unix", str(sockets[0]))}
        finally:
            for child in (server, model):
                child.terminate()
            for child in (server, model):
                child.wait(60)


def wait_for(log: Path, pattern: str) -> str:
    """Match in a line of the log; ends the benchmark if it does not appear."""
    deadline_s = time.monotonic() + START_S
    while not (found := re.search(pattern, log.read_text(encoding="utf-8"))):
        if time.monotonic() > deadline_s:
            raise SystemExit(
                f"{pattern!r} is not in the log:\n{log.read_text(encoding='utf-8')[-2000:]}"
            )
        time.sleep(0.05)
    return found.group(1)


def stop(port: int, timeout_s: float) -> float:
    """Time of a stop by a new client: connection, session and call [s]; infinite if it failed."""
    begun_s = time.monotonic()
    session: dict[str, str] = {}
    hello = {
        "protocolVersion": "2025-06-18",
        "capabilities": {},
        "clientInfo": {"name": "bench", "version": "1"},
    }
    calls: tuple[tuple[str, dict[str, Any]], ...] = (
        ("initialize", hello),
        ("tools/call", {"name": "emergency_stop", "arguments": {"reason": "benchmark"}}),
    )
    try:
        with closing(HTTPConnection("127.0.0.1", port, timeout=timeout_s)) as connection:
            for number, (method, params) in enumerate(calls):
                body = json.dumps(
                    {"jsonrpc": "2.0", "id": number, "method": method, "params": params}
                )
                connection.request("POST", "/mcp", body, {**_headers(), **session})
                answer = connection.getresponse()
                text = answer.read().decode()
                if answer.status != 200 or '"error"' in text or '"isError":true' in text:
                    return float("inf")
                found = answer.getheader("mcp-session-id")
                session = (
                    {"mcp-session-id": found, "mcp-protocol-version": "2025-06-18"}
                    if found
                    else session
                )
            took_s = time.monotonic() - begun_s
            with suppress(OSError, HTTPException):
                connection.request("DELETE", "/mcp", headers={**_headers(), **session})
                connection.getresponse().read()
            return took_s
    except (OSError, HTTPException):
        return float("inf")


def _headers() -> dict[str, str]:
    return {
        "Authorization": f"Bearer {TOKEN}",
        "Accept": "application/json, text/event-stream",
        "Content-Type": "application/json",
    }


def press_page(port: int, timeout_s: float) -> float:
    """Time of a stop on the page by a new connection [s]; infinite if it failed."""
    begun_s = time.monotonic()
    try:
        with closing(HTTPConnection("127.0.0.1", port, timeout=timeout_s)) as connection:
            connection.request("GET", "/emergency_stop", headers={"X-RoboNeuron": "stop"})
            answer = connection.getresponse()
            answer.read()
            took_s = time.monotonic() - begun_s
            return took_s if answer.status == 200 else float("inf")
    except (OSError, HTTPException):
        return float("inf")


def measure(
    state: Path, port: int, trials: int, press: Callable[[int, float], float] = stop
) -> tuple[list[float], int]:
    """Times of stops [s], and the number of them that latched."""
    latch = EmergencyStopLatch(state / ESTOP_FILE, time.time_ns)
    audit = AuditLog(state / "bench.jsonl", time.time_ns)
    times_s, latched = [], 0
    for _ in range(trials):
        times_s.append(press(port, 10.0))
        latched += (state / ESTOP_FILE).exists()
        if (state / ESTOP_FILE).exists():
            latch.is_latched()
            latch.reset(who="benchmark", role="admin", audit=audit)
    audit.close()
    return times_s, latched


def main(arguments: argparse.Namespace) -> int:
    """Flood each port in both ways; 1 if a stop took too long."""
    is_good = True
    with tempfile.TemporaryDirectory() as name:
        state = Path(name)
        with running(state) as ports:
            http = int(ports["http"][1])
            measure(state, http, 3)
            show("nothing", *measure(state, http, arguments.trials))
            for port in arguments.ports:
                floods = [("idle", IDLE), ("connects", arguments.rate)]
                if port in ("http", "view"):
                    floods.append(("requests", arguments.requests))
                if port == "http":
                    floods.append(("calls", arguments.requests))
                for kind, number in [one for one in floods if one[0] in arguments.floods]:
                    seconds = str(arguments.trials * 1.5 + 5)
                    command = [
                        sys.executable,
                        "-c",
                        FLOOD,
                        kind,
                        port if kind in ("requests", "calls") else ports[port][0],
                        ports[port][1],
                        str(number),
                        seconds,
                    ]
                    environment = os.environ | {"BENCH_FLOOD": FLOOD_TOKEN}
                    with subprocess.Popen(
                        command, stdout=subprocess.PIPE, text=True, env=environment
                    ) as flood:
                        assert flood.stdout is not None
                        flood.stdout.readline()
                        pressed = press_page if port == "view" else stop
                        aimed = int(ports[port][1]) if port == "view" else http
                        times_s, latched = measure(state, aimed, arguments.trials, pressed)
                        flood.terminate()
                        rest = flood.stdout.read().strip()
                    rate = (
                        f"{float(rest):,.0f} a second"
                        if kind == "connects" and rest
                        else f"{number:,} {WORDS[kind]}"
                    )
                    show(f"{port}: {rate}", times_s, latched)
                    is_good &= latched == arguments.trials and max(times_s) <= LIMIT_S
        log = (state / "server.log").read_text(encoding="utf-8")
        print(f"server's log: {len(log):,} characters, {log.count('Traceback')} tracebacks")
    return 0 if is_good else 1


def show(what: str, times_s: list[float], latched: int) -> None:
    """Print a line."""
    within = sum(took_s <= LIMIT_S for took_s in times_s)
    print(
        f"{what:34} {within}/{len(times_s)} within {LIMIT_S:g} s, {latched} latched; median "
        f"{statistics.median(times_s) * 1e3:.0f} ms, longest {max(times_s) * 1e3:.0f} ms",
        flush=True,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument(
        "--ports",
        nargs="+",
        default=["http", "metrics", "view", "shared-model"],
        choices=["http", "metrics", "view", "shared-model"],
    )
    parser.add_argument("--floods", nargs="+", default=[*WORDS], choices=[*WORDS])
    parser.add_argument("--rate", type=int, default=RATE, help="connects a second")
    parser.add_argument("--requests", type=int, default=REQUESTS, help="requests at once")
    sys.exit(main(parser.parse_args()))
