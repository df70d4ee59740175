"""Overhead of a model on another machine, compared with calling it in the robot's own process, over
a link without latency.

    python benchmarks/bench_serve_policy.py [--rounds 300] [--side 224]

A backend that computes nothing gets requests with one image, interleaved: in this process, over the
Unix socket of the shared backend, and over `roboneuron policy serve` with TLS 1.3 on the loopback
interface with the keys of a link. The floor is an echo in Python over TLS with the same keys: the
same number of bytes in each direction. Images are sent raw. CPU is user and system time of all
processes for one observation, divided by the time of the round trip.

Bound: at 224x224 the boundary over TLS (its time minus that in process) costs at most 2.0 ms in the
median.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.plugin import SHARED
from rn_backend_openpi.serve_command import name_of
from rn_backend_openpi.statistics import ask_status
from rn_link.keys import (
    add_peer,
    make_machine,
    new_identity,
    own_certificate,
    to_certificate,
)
from rn_link.machine import Machine, Peer, read_machine
from rn_link.tls import tls_context
from rn_testing.fakes.backend import make_observation
from rn_testing.fakes.site import PluginSite
from rn_testing.waiting import wait_until
from roboneuron import ActionChunk, NotReadyError, Observation

MOST_MS, JUDGED_SIDE = 2.0, 224
MISSED = "missed: "
ANSWER_BYTES = 1400
ROWS, STEP_S = 16, 0.05
SOURCE = f"""
import numpy as np

from roboneuron import ActionChunk, BackendSpec, hookimpl


class Null:
    def __init__(self, config, *, runtime=None, acceleration=None):
        pass

    def load(self):
        pass

    def predict(self, observation):
        return self.predict_batch([observation])[0]

    def predict_batch(self, observations):
        chunk = ActionChunk(actions=np.full(({ROWS}, 7), 0.5), step_s={STEP_S})
        return [chunk for _ in observations]

    def reset(self):
        pass

    def close(self):
        pass


@hookimpl
def roboneuron_backends():
    return [BackendSpec(name="null-benchmark", summary="Nothing.", target=__name__ + ":Null")]
"""
ECHO = """
import socket, sys
from pathlib import Path
from rn_link.machine import read_machine
from rn_link.tls import tls_context
folder = Path(sys.argv[1])
asked, answered = int(sys.argv[2]), bytes(int(sys.argv[3]))
context = tls_context(read_machine(folder), folder, "robot")
listener = socket.create_server(("127.0.0.1", 0))
print(listener.getsockname()[1], flush=True)
connected, _ = listener.accept()
connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
connected = context.wrap_socket(connected, server_side=True)
buffer = memoryview(bytearray(asked))
while True:
    filled = 0
    while filled < asked:
        count = connected.recv_into(buffer[filled:])
        if not count:
            sys.exit()
        filled += count
    connected.sendall(answered)
"""
Ask = Callable[[], object]


def pair(folder: Path) -> None:
    """Create the state directories `robot` and `gpu` of two paired machines."""
    hub, member = (folder / name / "roboneuron" / "link" for name in ("robot", "gpu"))
    make_machine(hub, Machine(name="robot", role="hub"), new_identity())
    identity = new_identity()
    peers = {"robot": Peer("127.0.0.1", own_certificate(hub))}
    make_machine(member, Machine(name="gpu", role="member", peers=peers), identity)
    add_peer(hub, "gpu", Peer("127.0.0.1", to_certificate(identity)))


def cpu_s(pids: Sequence[int]) -> float:
    """User and system time of processes [s]."""
    ticks = 0
    for pid in pids:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(words[11]) + int(words[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def started(stack: ExitStack, words: Sequence[str], **more: Any) -> subprocess.Popen[str]:
    """A process that ends with the stack."""
    process = subprocess.Popen(words, text=True, **more)

    def end() -> None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(30.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(30.0)

    stack.callback(end)
    return process


def serve(stack: ExitStack, folder: Path, environment: Mapping[str, str]) -> tuple[str, list[int]]:
    """Start `roboneuron policy serve`; returns its address and its processes."""
    config = folder / "policies.toml"
    config.write_text(
        f'[listen]\nport = 0\ndirectory = "{folder / "run"}"\n'
        '[models.null]\nbackend = "null-benchmark"\n'
    )
    log = stack.enter_context((folder / "server.log").open("w"))
    words = [
        sys.executable,
        "-m",
        "roboneuron.cli.main",
        "policy",
        "serve",
        "--config",
        str(config),
    ]
    own = {**environment, "XDG_STATE_HOME": str(folder / "gpu")}
    process = started(stack, words, env=own, stdout=log, stderr=log)
    told: dict[str, Any] = {}

    def is_ready() -> bool:
        try:
            told.update(ask_status(folder / "run" / f"{name_of(config)}.sock"))
        except NotReadyError:
            return False
        return bool(told["models"]["null"]["state"] == "ready")

    wait_until(is_ready, 60.0, "the server is ready")
    return told["address"], [process.pid, told["models"]["null"]["pid"]]


def echo(
    stack: ExitStack, folder: Path, environment: Mapping[str, str], asked: int
) -> tuple[Ask, int]:
    """Client of an echo over TLS, and the process of the echo."""
    gpu, robot = (folder / name / "roboneuron" / "link" for name in ("gpu", "robot"))
    words = [sys.executable, "-c", ECHO, str(gpu), str(asked), str(ANSWER_BYTES)]
    process = started(stack, words, env=environment, stdout=subprocess.PIPE)
    assert process.stdout is not None
    port = int(process.stdout.readline())
    machine = read_machine(robot)
    assert machine is not None
    raw = socket.create_connection(("127.0.0.1", port))
    raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connected = stack.enter_context(tls_context(machine, robot, "gpu").wrap_socket(raw))
    sent, buffer = bytes(asked), memoryview(bytearray(ANSWER_BYTES))

    def ask() -> None:
        connected.sendall(sent)
        filled = 0
        while filled < ANSWER_BYTES:
            filled += connected.recv_into(buffer[filled:])

    return ask, process.pid


def seen(side: int) -> Observation:
    """An observation with one image of noise."""
    observation = make_observation(SHARED)
    image = np.random.default_rng(0).integers(0, 256, (side, side, 3), dtype=np.uint8)
    frame = replace(observation.frames["primary"], image=image)
    return replace(observation, frames={"primary": frame})


def main() -> int:
    """Run it; exit status 0 unless something fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=300)
    parser.add_argument("--side", type=int, default=224, help="of the image [px]")
    given = parser.parse_args()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        (folder / "run").mkdir(mode=0o700)
        PluginSite(path=folder / "site").install("rn-null-benchmark", SOURCE, header="")
        path = os.pathsep.join(filter(None, (str(folder / "site"), os.environ.get("PYTHONPATH"))))
        environment = {**os.environ, "PYTHONPATH": path}
        pair(folder)
        os.environ["XDG_STATE_HOME"] = str(folder / "robot")
        address, served = serve(stack, folder, environment)
        observation = seen(given.side)
        asked = observation.frames["primary"].image.nbytes + 900
        ask_echo, echoing = echo(stack, folder, environment, asked)
        far = PolicyBackend(
            PolicyOptions(address=address, coding="raw", timeout_s=30.0, start_timeout_s=60.0)
        )
        near = PolicyBackend(
            PolicyOptions(
                backend="null-benchmark",
                directory=folder / "run",
                environment={"PYTHONPATH": path},
                timeout_s=30.0,
                idle_s=5.0,
            )
        )
        for backend in (far, near):
            stack.callback(backend.close)
            backend.load()

        def here() -> ActionChunk:
            return ActionChunk(actions=np.full((ROWS, 7), 0.5), step_s=STEP_S)

        ways: dict[str, Ask] = {
            "in this process": here,
            "echo over TLS": ask_echo,
            "shared, Unix socket": lambda: near.predict(observation),
            "policy serve, TLS": lambda: far.predict(observation),
        }
        took_ms = measure(ways, given.rounds)
        own = [os.getpid()]
        shares = {
            "echo over TLS": cpu_share(ask_echo, [*own, echoing], given.rounds),
            "policy serve, TLS": cpu_share(
                ways["policy serve, TLS"], [*own, *served], given.rounds
            ),
        }
        print(f"{given.side}x{given.side}, {given.rounds} rounds, load {load:.1f}")
        for way, times in took_ms.items():
            p99 = sorted(times)[int(0.99 * len(times))]
            share = f", {shares[way]:.0%} of a CPU" if way in shares else ""
            print(f"{way:<22} median {statistics.median(times):6.3f} ms, p99 {p99:6.2f} ms{share}")
        pairs = list(zip(took_ms["policy serve, TLS"], took_ms["in this process"], strict=True))
        boundary_ms = statistics.median(far_ms - here_ms for far_ms, here_ms in pairs)
        floor_ms = statistics.median(took_ms["echo over TLS"])
        print(
            f"the boundary costs {boundary_ms:.2f} ms, {boundary_ms / floor_ms:.1f} times the echo"
        )
        if given.side == JUDGED_SIDE and boundary_ms > MOST_MS:
            print(f"{MISSED}the boundary costs {boundary_ms:.2f} ms, more than {MOST_MS:g}")
    return 0


def measure(ways: Mapping[str, Ask], rounds: int) -> dict[str, list[float]]:
    """Times of each way, interleaved [ms]; the first ones are not counted."""
    took_ms: dict[str, list[float]] = {way: [] for way in ways}
    for number in range(rounds + 20):
        for way, ask in ways.items():
            begun_s = time.perf_counter()
            ask()
            if number >= 20:
                took_ms[way].append((time.perf_counter() - begun_s) * 1e3)
    return took_ms


def cpu_share(ask: Ask, pids: Sequence[int], rounds: int) -> float:
    """CPU load (in cores) of these processes during continuous requests."""
    before_s, begun_s = cpu_s(pids), time.monotonic()
    for _ in range(rounds):
        ask()
    return (cpu_s(pids) - before_s) / (time.monotonic() - begun_s)


if __name__ == "__main__":
    sys.exit(main())
