"""Latency from an image to the action at the controller: RoboNeuron's inference process compared
with a bare rclpy relay, interleaved in one run.

    python benchmarks/bench_loop.py [--frames 300] [--rounds 3]

Both answer at once, so the difference is RoboNeuron's overhead: conversion, hand-over between
threads, checks, status. "Added" is the difference of the medians: the cost of the boundary. "Oldest
frame" is the largest age of an action's image when the action arrives; it must stay below one
camera period.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rn_testing.domain import free_ros_domain
from roboneuron.config import ModuleSettings, parse_config
from roboneuron.modules.execution.plugin import FEATURE as EXECUTION
from roboneuron.ros.environment import prepare_environment
from roboneuron.supervisor.changes import Changes
from roboneuron.supervisor.lifecycle import NodeClient

HERE = Path(__file__).parent
RATE_HZ = 30.0
SIZES = {"224x224": (224, 224), "640x480": (480, 640)}
WARM_UP = 30
TRANSITION_S = 30.0
CONFIGURATION = '[robot]\nname = "bench"\n[inference]\nbackend = "echo"\ninstruction = "go"\n'


class Camera:
    """Publishes numbered images and notes the arrival of each action."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import Image
        from std_msgs.msg import Float64MultiArray

        rclpy.init()
        self.node = rclpy.create_node("camera")
        self.sent_s: dict[int, float] = {}
        self.answers: list[tuple[int, float]] = []
        self._publisher = self.node.create_publisher(
            Image, "/bench/camera/front/image", QoSProfile(depth=1)
        )
        self.node.create_subscription(
            Float64MultiArray, "/bench/action", self._on_action, QoSProfile(depth=1)
        )
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=0.1)

    def close(self) -> None:
        """Shut the node down."""
        import rclpy

        self._stop.set()
        self._thread.join(5.0)
        self.node.destroy_node()
        rclpy.try_shutdown()

    def _on_action(self, message: Any) -> None:
        self.answers.append((int(message.data[0]), time.perf_counter()))

    def wait_for_peer(self) -> None:
        """Wait until exactly one process subscribes to images and one publishes actions."""
        end_s = time.monotonic() + 30
        while time.monotonic() < end_s:
            if (
                self._publisher.get_subscription_count() == 1
                and self.node.count_publishers("/bench/action") == 1
            ):
                return
            time.sleep(0.02)
        sys.exit("the other process was not found within 30 s")

    def wait_until_alone(self) -> None:
        """Wait until no process publishes actions; an ended process stays in the graph for up to 20
        s.
        """
        end_s = time.monotonic() + 60
        while self.node.count_publishers("/bench/action"):
            if time.monotonic() > end_s:
                sys.exit("the ended process was still in the ROS graph after 60 s")
            time.sleep(0.02)

    def run(self, height: int, width: int, frames: int) -> tuple[np.ndarray, float, int]:
        """Publish at RATE_HZ; returns latencies [s], the age of the oldest image used [s], and the
        number of answers.
        """
        from roboneuron.contract import Frame
        from roboneuron.ros.messages import to_image

        self.sent_s.clear()
        self.answers.clear()
        image = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
        start_s = time.perf_counter()
        for number in range(frames + WARM_UP):
            time.sleep(max(0.0, start_s + number / RATE_HZ - time.perf_counter()))
            image[0].reshape(-1)[:4] = np.frombuffer(number.to_bytes(4, "little"), dtype=np.uint8)
            stamp_ns = self.node.get_clock().now().nanoseconds
            self.sent_s[number] = time.perf_counter()
            self._publisher.publish(
                to_image(Frame(camera="front", image=image, stamp_ns=stamp_ns, frame_id="front"))
            )
        time.sleep(0.3)
        latencies = np.array(
            [at - self.sent_s[number] for number, at in self.answers if number >= WARM_UP]
        )
        if not latencies.size:
            sys.exit(f"none of {frames} images was answered")
        return latencies, float(latencies.max()), latencies.size


def end(process: subprocess.Popen[bytes]) -> None:
    """Wait until the process has ended; kill it if it does not."""
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(10)


def activate(process: subprocess.Popen[bytes], log: Path) -> None:
    """Configure and activate the inference module; lost requests or answers are repeated.

    A service that has not discovered its caller yet cannot answer: on a fast machine this affects
    the first request.
    """
    from roboneuron.ros.link import RosLink

    def check() -> None:
        if process.poll() is not None:
            sys.exit(f"the inference process ended:\n{log.read_text()}")

    link = RosLink("bench_lifecycle")
    link.open()
    try:
        client = NodeClient(link, Changes(), "/bench/inference", lambda digest: None, check)
        if not client.wait_until_served(TRANSITION_S):
            sys.exit(
                f"the inference process did not come up within {TRANSITION_S:g} "
                f"s:\n{log.read_text()}"
            )
        for transition in ("configure", "activate"):
            if not client.transition(transition, TRANSITION_S):
                sys.exit(
                    f"the inference process did not {transition} within {TRANSITION_S:g} "
                    f"s:\n{log.read_text()}"
                )
    finally:
        link.close()


@contextmanager
def relay(environment: dict[str, str]) -> Iterator[None]:
    """The bare relay process."""
    # a new session as for the module: the kernel distributes processor time by sessions
    process = subprocess.Popen(
        [sys.executable, str(HERE / "loop_relay.py")], env=environment, start_new_session=True
    )
    try:
        yield
    finally:
        process.terminate()
        end(process)


@contextmanager
def inference(
    environment: dict[str, str], scratch: Path, configuration: str = CONFIGURATION
) -> Iterator[None]:
    """RoboNeuron's inference module in its process, configured and active; the robot is named
    "bench".
    """
    settings = ModuleSettings(
        kind="inference",
        node_name="inference",
        config=parse_config(configuration),
        state_directory=str(scratch),
        on_join=(EXECUTION.on_join or "",),
    )
    with (scratch / "inference.log").open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "roboneuron.modules"],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    assert process.stdin is not None
    try:
        process.stdin.write(settings.model_dump_json().encode() + b"\n")
        process.stdin.flush()
        activate(process, scratch / "inference.log")
        yield
    finally:
        process.stdin.close()
        end(process)


def install(scratch: Path) -> Path:
    """Folder of the plugin whose backend answers at once; created if missing."""
    site = scratch / "site"
    info = site / "echo_plugin-1.0.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    shutil.copy(HERE / "echo_plugin.py", site)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: echo-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[roboneuron]\necho-plugin = echo_plugin\n")
    return site


def measure(frames: int, rounds: int, scratch: Path) -> Table:
    """Run both, interleaved, for every size."""
    site = install(scratch)
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    prepare_environment(scratch / "log")
    environment = os.environ | {"PYTHONPATH": str(site)}
    camera = Camera()
    try:
        return compare(camera, environment, scratch, frames=frames, rounds=rounds)
    finally:
        camera.close()


def compare(
    camera: Camera, environment: dict[str, str], scratch: Path, *, frames: int, rounds: int
) -> Table:
    """The table of both processes, interleaved, for every size."""
    found: dict[tuple[str, str], list[np.ndarray]] = {}
    oldest_s: dict[tuple[str, str], float] = {}
    for _ in range(rounds):
        # a camera that changes its size is refused, so each size gets a process
        for size, (height, width) in SIZES.items():
            for name in ("relay", "inference"):
                peer = relay(environment) if name == "relay" else inference(environment, scratch)
                with peer:
                    camera.wait_for_peer()
                    latencies, oldest, _ = camera.run(height, width, frames)
                found.setdefault((size, name), []).append(latencies)
                oldest_s[size, name] = max(oldest, oldest_s.get((size, name), 0.0))
                camera.wait_until_alone()
    table = Table(
        title=f"Image -> action at the controller, {RATE_HZ:g} Hz, {rounds} rounds of {frames} "
        "frames in turns"
    )
    for column in (
        "size",
        "process",
        "answers",
        "median ms",
        "p99 ms",
        "median ratio",
        "p99 ratio",
        "added ms",
        "oldest frame ms",
    ):
        table.add_column(column, justify="right")
    for size in SIZES:
        floor = np.percentile(np.concatenate(found[size, "relay"]), [50, 99])
        for name in ("relay", "inference"):
            values = np.concatenate(found[size, name])
            median, p99 = np.percentile(values, [50, 99])
            table.add_row(
                size,
                {"relay": "bare rclpy relay", "inference": "RoboNeuron"}[name],
                f"{values.size}/{rounds * frames}",
                f"{median * 1e3:.2f}",
                f"{p99 * 1e3:.2f}",
                f"{median / floor[0]:.2f}",
                f"{p99 / floor[1]:.2f}",
                f"{(median - floor[0]) * 1e3:.2f}",
                f"{oldest_s[size, name] * 1e3:.1f}",
            )
    return table


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        table = measure(arguments.frames, arguments.rounds, Path(directory))
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
