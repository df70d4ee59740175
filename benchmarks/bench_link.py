"""Images over the encrypted link compared with plain UDP, on a link with delay and packet loss.

    python benchmarks/bench_link.py [--seconds 10] [--delays 0 10 25] [--losses 0 1]

Two network namespaces, joined by a program that forwards Ethernet frames: each after the delay [ms,
one way], and each lost with the probability [%], both ways. A process in one sends 224x224 images
at 30 Hz, best effort; one in the other reports the received images and their latencies (both read
the same monotonic clock). The floors are the same bytes in a bare TCP and a bare TLS stream. Needs
root.
"""

from __future__ import annotations

import argparse
import ctypes
import fcntl
import heapq
import json
import os
import random
import select
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "plugins" / "rn-link" / "tests"))

from link_machines import Machine, impossible  # noqa: E402
from link_pairs import pair  # noqa: E402

FLOORS = ("TCP", "TLS")
PORT = 7500
RATE_HZ = 30.0
SIDE = 224
_NEW_NET = 0x40000000
_SET_INTERFACE = 0x400454CA
_TAP_WITHOUT_HEADER = 0x1002
_MOST_FRAME = 65_536


def open_tap(machine: Machine, device: str) -> int:
    """Create an Ethernet device in that machine; returns the descriptor of its other end."""
    made: list[int] = []

    def enter() -> None:  # on a new thread, because a change of namespace affects only its thread
        with open(f"/proc/{machine.pid}/ns/net", "rb") as namespace:
            libc = ctypes.CDLL(None, use_errno=True)
            if libc.setns(namespace.fileno(), _NEW_NET) != 0:
                raise OSError(ctypes.get_errno(), "setns")
        tap = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        request = struct.pack("16sH22x", device.encode(), _TAP_WITHOUT_HEADER)
        fcntl.ioctl(tap, _SET_INTERFACE, request)
        made.append(tap)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join(5.0)
    return made[0]


class Cable:
    """Forwards frames between two devices, from `start` to `close`.

    Args:
        delay_s: delay of each frame [s].
        loss: probability that a frame is lost, 0 to 1.
    """

    def __init__(self, ends: tuple[int, int], delay_s: float, loss: float) -> None:
        self._ends = ends
        self._delay_s = delay_s
        self._loss = loss
        self._random = random.Random(1)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def start(self) -> None:
        """Start on its own thread."""
        self._thread.start()

    def close(self) -> None:
        """End it."""
        self._stopping.set()
        self._thread.join(5.0)

    def _run(self) -> None:
        waiting: list[tuple[float, int, int, bytes]] = []
        number = 0
        others = dict(zip(self._ends, reversed(self._ends), strict=True))
        while not self._stopping.is_set():
            wait_s = 0.05 if not waiting else max(0.0, waiting[0][0] - time.monotonic())
            ready, _, _ = select.select(self._ends, [], [], min(wait_s, 0.05))
            for end in ready:
                frame = os.read(end, _MOST_FRAME)
                if self._random.random() >= self._loss:
                    number += 1
                    due_s = time.monotonic() + self._delay_s
                    heapq.heappush(waiting, (due_s, number, others[end], frame))
            while waiting and waiting[0][0] <= time.monotonic():
                *_, end, frame = heapq.heappop(waiting)
                try:
                    os.write(end, frame)
                except BlockingIOError:  # the device's queue is full: a packet is lost
                    continue


def node(role: str, report: Path, seconds: float) -> None:
    """Run one of the two processes."""
    from rn_link.environment import join_link
    from rn_link.keeper import keep_link
    from roboneuron.command import environment

    join_link()
    environment.prepare_environment(report.parent)
    import array

    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Image

    rclpy.init()
    keep_link()
    made = rclpy.create_node(f"link_{role}")
    if role == "receiver":
        delays_s: list[tuple[float, float]] = []

        def receive(image: Image) -> None:
            sent_s = float(image.header.frame_id)
            delays_s.append((sent_s, time.monotonic() - sent_s))

        made.create_subscription(Image, "/image", receive, qos_profile_sensor_data)
        while not report.with_suffix(".end").exists():
            rclpy.spin_once(made, timeout_sec=0.05)
        report.write_text(json.dumps(delays_s))
        os._exit(0)
    publisher = made.create_publisher(Image, "/image", qos_profile_sensor_data)
    image = Image(height=SIDE, width=SIDE, encoding="rgb8", step=3 * SIDE)
    image.data = array.array("B", os.urandom(SIDE * SIDE * 3))
    deadline_s = time.monotonic() + 30.0
    while publisher.get_subscription_count() == 0 and time.monotonic() < deadline_s:
        rclpy.spin_once(made, timeout_sec=0.05)
    time.sleep(2.0)  # until the connection has reached its rate
    sent_s: list[float] = []
    for number in range(int(seconds * RATE_HZ)):
        sent_s.append(time.monotonic())
        image.header.frame_id = repr(sent_s[-1])
        publisher.publish(image)
        time.sleep(max(0.0, sent_s[0] + (number + 1) / RATE_HZ - time.monotonic()))
    time.sleep(2.0)  # for messages in transit
    report.write_text(json.dumps(sent_s))
    os._exit(0)


def stream(role: str, report: Path, seconds: float, over: str) -> None:
    """Run one side of a floor: the same bytes in one stream, preceded by the send time."""
    from rn_link.machine import link_folder, read_machine
    from rn_link.tls import tls_context

    machine = read_machine(link_folder())
    assert machine is not None
    ((name, peer),) = machine.peers.items()
    context = tls_context(machine, link_folder(), name) if over == "TLS" else None
    size = 8 + SIDE * SIDE * 3
    if role == "receiver":
        plain, _ = socket.create_server(("0.0.0.0", PORT)).accept()
        connection = context.wrap_socket(plain, server_side=True) if context else plain
        delays_s = []
        with connection.makefile("rb") as lines:
            while len(image := lines.read(size)) == size:
                (sent_s,) = struct.unpack_from("d", image)
                delays_s.append((sent_s, time.monotonic() - sent_s))
        report.write_text(json.dumps(delays_s))
        return
    plain = _connect(peer.address)
    plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection = context.wrap_socket(plain) if context else plain
    noise = os.urandom(size - 8)
    begun_s = time.monotonic()
    sent = []
    for number in range(int(seconds * RATE_HZ)):
        sent.append(time.monotonic())
        connection.sendall(struct.pack("d", sent[-1]) + noise)
        time.sleep(max(0.0, begun_s + (number + 1) / RATE_HZ - time.monotonic()))
    report.write_text(json.dumps(sent))
    connection.close()


def _connect(address: str) -> socket.socket:
    deadline_s = time.monotonic() + 20.0
    while True:
        try:
            return socket.create_connection((address, PORT), 20.0)
        except OSError:  # not listening yet
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.05)


def measure(over: str, delay_ms: float, loss_percent: float, seconds: float) -> str:
    """One row of the table."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        sides = [
            stack.enter_context(Machine(folder, name, number))
            for number, name in enumerate(("robot", "gpu"), 1)
        ]
        ends = tuple(open_tap(side, "cable") for side in sides)
        for end in ends:
            stack.callback(os.close, end)
        for side in sides:
            side.run("ip", "addr", "add", f"{side.address}/24", "dev", "cable")
            for device in ("lo", "cable"):
                side.run("ip", "link", "set", device, "up")
            side.run("ip", "route", "add", "224.0.0.0/4", "dev", "cable")
        cable = Cable((ends[0], ends[1]), delay_ms / 1e3, loss_percent / 100)
        cable.start()
        stack.callback(cable.close)
        if over != "UDP":
            pair(*sides)
        return _row(over, delay_ms, loss_percent, _run(over, sides, seconds))


def _run(over: str, sides: Sequence[Machine], seconds: float) -> list[float | None]:
    """Latency of each image [s]; None for a lost one."""
    robot, gpu = sides
    processes = []
    for side, role in ((gpu, "receiver"), (robot, "sender")):
        environment = {
            **os.environ,
            "XDG_STATE_HOME": str(side.state),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        }
        report = side.state / role
        command = [sys.executable, __file__, "--node", role, str(report), str(seconds), over]
        processes.append(subprocess.Popen(side.inside(*command), env=environment))
    receiver, sender = processes
    try:
        sender.wait(60.0 + seconds)
        (gpu.state / "receiver.end").touch()
        receiver.wait(20.0)
    finally:
        for process in processes:
            process.kill()
            process.wait(10.0)
    sent = json.loads((robot.state / "sender").read_text())
    delays = dict(json.loads((gpu.state / "receiver").read_text()))
    return [delays.get(sent_s) for sent_s in sent]


def _row(over: str, delay_ms: float, loss: float, found: Sequence[float | None]) -> str:
    came = sorted(one * 1e3 for one in found if one is not None)
    share = len(came) / len(found)
    times = ""
    if came:
        late = came[min(len(came) - 1, int(len(came) * 0.99))]
        times = f"{statistics.median(came):7.1f} {late:7.1f} {came[-1]:7.1f}"
    return f"{delay_ms:5g} {loss:5g}  {over:<5} {share:7.1%} {times}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--delays", type=float, nargs="+", default=[0.0, 10.0, 25.0])
    parser.add_argument("--losses", type=float, nargs="+", default=[0.0, 1.0])
    parser.add_argument("--node", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.node:
        role, report, seconds, over = arguments.node
        if over in FLOORS:
            stream(role, Path(report), float(seconds), over)
            return
        node(role, Path(report), float(seconds))
    if reason := impossible():
        sys.exit(f"This benchmark {reason}.")
    print("delay  loss  over   arrived     p50     p99     max  [ms, %]")
    for delay_ms in arguments.delays:
        for loss in arguments.losses:
            for over in ("UDP", *FLOORS, "link"):
                print(measure(over, delay_ms, loss, arguments.seconds), flush=True)


if __name__ == "__main__":
    main()
