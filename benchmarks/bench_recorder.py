"""Overhead of recording: two cameras 640x480 at 30 Hz, joints at 120 Hz, with and without the
recorder, interleaved.

A source publishes images and joint states, a relay answers each image of the first camera with an
action, and the source measures the time from an image's stamp to its action. In every other turn a
recorder (JPEG) runs too. At the end the files are read to find published messages that are missing
in them.

    python benchmarks/bench_recorder.py                   # 2 minutes
    python benchmarks/bench_recorder.py --minutes 10      # the figure in benchmarks.md
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from rn_recorder_runs.reading import count_topics
from rn_recorder_runs.settings import RecorderSettings, RulesSettings, spawn_recorder
from rn_recorder_runs.store import RunStore
from rn_testing.domain import free_ros_domain
from roboneuron.ros.environment import prepare_environment

CAMERAS = ("front", "wrist")
WIDTH, HEIGHT, IMAGE_HZ, JOINT_HZ = 640, 480, 30.0, 120.0


def source(seconds: float) -> None:
    """Publish, and print the latencies of actions [ms] as JSON."""
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from sensor_msgs.msg import Image, JointState
    from std_msgs.msg import Float64MultiArray

    from roboneuron import Frame
    from roboneuron.ros.messages import to_image
    from roboneuron.ros.qos import NEWEST

    rclpy.init()
    node = rclpy.create_node("bench_source")
    images = [
        node.create_publisher(Image, f"/bench/camera/{name}/image", NEWEST) for name in CAMERAS
    ]
    joints = node.create_publisher(JointState, "/bench/joint_states", NEWEST)
    latencies: list[float] = []
    sent: dict[int, int] = {}

    def on_action(message: Float64MultiArray) -> None:
        number = int(message.data[0])
        if number in sent:
            latencies.append((time.time_ns() - sent.pop(number)) / 1e6)

    node.create_subscription(Float64MultiArray, "/bench/action", on_action, 10)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> None:
        with suppress(ExternalShutdownException):
            executor.spin()

    threading.Thread(target=spin, daemon=True).start()
    random = np.random.default_rng(0)
    ramp = np.linspace(0, 200, WIDTH)[None, :, None] + random.normal(0, 6, (HEIGHT, WIDTH, 3))
    pictures = [np.roll(ramp, 40 * i, axis=1).clip(0, 255).astype(np.uint8) for i in range(8)]

    def move() -> None:
        due_s = time.monotonic()
        while time.monotonic() < end_s:
            message = JointState(
                name=[f"joint{i}" for i in range(9)], position=[0.1] * 9, velocity=[0.0] * 9
            )
            message.header.stamp = node.get_clock().now().to_msg()
            joints.publish(message)
            due_s += 1 / JOINT_HZ
            time.sleep(max(0.0, due_s - time.monotonic()))

    time.sleep(3.0)  # until all have discovered each other
    end_s = time.monotonic() + seconds
    moving = threading.Thread(target=move)
    moving.start()
    due_s, number = time.monotonic(), 0
    while time.monotonic() < end_s:
        number += 1
        for camera, publisher in zip(CAMERAS, images, strict=True):
            stamp_ns = time.time_ns()
            frame_id = f"{camera}_{number}"
            frame = Frame(
                camera=camera, image=pictures[number % 8], stamp_ns=stamp_ns, frame_id=frame_id
            )
            if camera == CAMERAS[0]:
                sent[number] = stamp_ns
            publisher.publish(to_image(frame))
        due_s += 1 / IMAGE_HZ
        time.sleep(max(0.0, due_s - time.monotonic()))
    moving.join(10.0)
    time.sleep(0.5)
    print(json.dumps({"images": number, "latencies": latencies}))
    rclpy.try_shutdown()


def relay() -> None:
    """Answer each image of the first camera with an action, until killed."""
    import rclpy
    from sensor_msgs.msg import Image
    from std_msgs.msg import Float64MultiArray

    from roboneuron.ros.qos import NEWEST

    rclpy.init()
    node = rclpy.create_node("bench_relay")
    publisher = node.create_publisher(Float64MultiArray, "/bench/action", NEWEST)

    def on_image(message: Image) -> None:
        number = float(message.header.frame_id.rpartition("_")[2])
        publisher.publish(Float64MultiArray(data=[number, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))

    node.create_subscription(Image, f"/bench/camera/{CAMERAS[0]}/image", on_image, NEWEST)
    with suppress(KeyboardInterrupt):
        rclpy.spin(node)


def record(directory: Path, turn: int) -> tuple[subprocess.Popen[bytes], list[dict[str, Any]]]:
    """Start a recorder that records, and collect its output."""
    rules = RulesSettings(
        ring_s=30.0,
        after_s=5.0,
        part_bytes=500_000_000,
        part_s=300.0,
        quota_bytes=10**11,
        min_free_bytes=10**8,
    )
    settings = RecorderSettings(
        namespace="bench",
        state_directory=directory / "state",
        directory=directory / "runs",
        topics=("*",),
        exclude=(),
        images="jpeg",
        jpeg_quality=85,
        rules=rules,
        about={"robot": "bench"},
    )
    child = spawn_recorder(settings, directory / "recorder.log", turn, ())
    assert child.stdin is not None
    child.stdin.write(
        json.dumps({"do": "start", "number": 1, "name": "bench", "facts": {}}).encode() + b"\n"
    )
    child.stdin.flush()
    answers: list[dict[str, Any]] = []

    def read() -> None:
        assert child.stdout is not None
        for line in child.stdout:
            answers.append(json.loads(line))

    threading.Thread(target=read, daemon=True).start()
    return child, answers


def turn_of(directory: Path, turn: int, seconds: float, *, recorded: bool) -> dict[str, Any]:
    """One turn; returns latencies and the recorder's CPU load."""
    child, answers = record(directory, turn) if recorded else (None, [])
    if child is not None:
        time.sleep(2.0)
    relaying = subprocess.Popen([sys.executable, __file__, "--relay"])
    playing = subprocess.Popen(
        [sys.executable, __file__, "--source", str(seconds)], stdout=subprocess.PIPE, text=True
    )
    share = None
    if child is not None:
        time.sleep(6.0)
        times, begun_s = psutil.Process(child.pid).cpu_times(), time.monotonic()
        time.sleep(max(1.0, seconds - 6.0))
        after = psutil.Process(child.pid).cpu_times()
        used_s = after.user + after.system - times.user - times.system
        share = used_s / (time.monotonic() - begun_s)
    output, _ = playing.communicate(timeout=seconds + 60)
    relaying.kill()
    relaying.wait(10.0)
    status: dict[str, Any] = {}
    if child is not None:
        time.sleep(1.0)
        status = next((answer["status"] for answer in reversed(answers) if "status" in answer), {})
        assert child.stdin is not None
        child.stdin.write(b'{"do": "leave"}\n')
        child.stdin.flush()
        child.wait(30)
    return {**json.loads(output), "share": share, "status": status}


def main() -> None:
    """Run the turns and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--minutes", type=float, default=2.0, help="of all turns together (default: 2)"
    )
    parser.add_argument("--turns", type=int, default=2, help="pairs of turns (default: 2)")
    parser.add_argument("--source", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--relay", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if not (arguments.source or arguments.relay):
        os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    with tempfile.TemporaryDirectory() as folder:
        prepare_environment(Path(folder) / "log")
        if arguments.relay:
            relay()
        elif arguments.source:
            source(arguments.source)
        else:
            measure(Path(folder), arguments.minutes * 60 / (2 * arguments.turns), arguments.turns)


def measure(directory: Path, seconds: float, pairs: int) -> None:
    """Both kinds of turns, interleaved."""
    found: dict[bool, list[dict[str, Any]]] = {False: [], True: []}
    for turn in range(2 * pairs):
        recorded = turn % 2 == 1
        found[recorded].append(turn_of(directory, turn, seconds, recorded=recorded))
    print(
        f"{2 * pairs} turns of {seconds:.0f} s, load average {os.getloadavg()[0]:.1f} on "
        f"{os.cpu_count()} cores\n"
    )
    print(f"{'':<12} {'images':>7} {'median ms':>10} {'p99 ms':>8} {'share of a core':>16}")
    p99 = {}
    for recorded, turns in found.items():
        latencies = [value for turn in turns for value in turn["latencies"]]
        p99[recorded] = float(np.percentile(latencies, 99))
        shares = [turn["share"] for turn in turns if turn["share"] is not None]
        share = f"{np.mean(shares) * 100:.1f} %" if shares else ""
        count = sum(turn["images"] for turn in turns)
        name = "recorded" if recorded else "alone"
        print(
            f"{name:<12} {count:>7} {np.median(latencies):>10.2f} {p99[recorded]:>8.2f} {share:>16}"
        )
    print(f"\nimage -> action, p99: {p99[True] / p99[False]:.2f} x that without the recorder")
    for run in RunStore(directory / "runs").runs():
        size = run.size_bytes / 1e6
        topics = {
            topic: c for topic, c in count_topics(run.files).items() if topic.startswith("/bench/")
        }
        lost_by = {topic: c.lost for topic, c in topics.items()}
        print(
            f"{run.id}: {sum(c.messages for c in topics.values())} messages, {size:.0f} MB, lost: "
            f"{lost_by}"
        )
    for recording in found[True]:
        status = recording["status"]
        lost = f"lost to disk {status.get('lost_to_disk')}, gaps {status.get('gaps')}"
        print(f"recorder: dropped {status.get('dropped')}, {lost}")


if __name__ == "__main__":
    main()
