"""Deriving every installed ROS interface, and what the checked encoder costs beside a hand-written
message fill.

    python benchmarks/bench_interfaces.py [--repeat 2000]

Deriving is measured cold, in this process, against its floor in the same run: importing the same
message classes. Memory is the growth of the resident set. Encoding and decoding are medians of
`--repeat` calls against the shortest hand-written code for the same message, which checks nothing.
Exit status 1 when an interface cannot be derived.
"""

from __future__ import annotations

import argparse
import base64
import importlib
import json
import statistics
import sys
import time
from array import array
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

from rn_standard.tools_ros.interfaces import (
    InterfaceName,
    MessageInterface,
    list_interfaces,
    load_interface,
    load_message,
)
from roboneuron.errors import RoboNeuronError

MEBIBYTE = 1024 * 1024


def resident_mib() -> float:
    """Resident memory of this process [MiB]."""
    return float(psutil.Process().memory_info().rss) / MEBIBYTE


def import_classes(names: tuple[InterfaceName, ...]) -> None:
    """The floor of deriving: nothing can be derived from a class that is not imported."""
    for name in names:
        getattr(importlib.import_module(f"{name.package}.{name.kind}"), name.name)


def derive(names: tuple[InterfaceName, ...]) -> tuple[list[MessageInterface], list[str]]:
    """Derive all; returns the messages, request, goals ... and the failures in words."""
    parts: list[MessageInterface] = []
    failures: list[str] = []
    for name in names:
        try:
            found: Any = load_interface(str(name))
        except RoboNeuronError as error:
            failures.append(f"{name}: {error}")
            continue
        words = {
            "msg": (),
            "srv": ("request", "response"),
            "action": ("goal", "result", "feedback"),
        }[found.kind]
        parts += [getattr(found, word) for word in words] or [found]
    return parts, failures


def bench_derive(console: Console) -> bool:
    """Time and memory of each step of deriving, cold. Returns whether everything was derived."""
    names = list_interfaces()
    table = Table(title=f"Deriving {len(names)} interfaces, cold", title_justify="left")
    for column in ("step", "time [ms]", "of the import", "memory [MiB]"):
        table.add_column(column, justify="left" if column == "step" else "right")
    results: dict[str, Any] = {}
    floor_ms = 0.0

    def measure(step: str, work: Callable[[], Any]) -> None:
        nonlocal floor_ms
        before, start = resident_mib(), time.perf_counter()
        results[step] = work()
        milliseconds = (time.perf_counter() - start) * 1e3
        floor_ms = floor_ms or milliseconds
        table.add_row(
            step,
            f"{milliseconds:.0f}",
            f"{milliseconds / floor_ms:.2f}",
            f"{resident_mib() - before:.1f}",
        )

    measure("import the classes (floor)", lambda: import_classes(names))
    measure("descriptions, encoders, decoders", lambda: derive(names))
    parts, failures = results["descriptions, encoders, decoders"]
    measure("JSON schemas", lambda: [len(json.dumps(part.json_schema())) for part in parts])
    measure("pydantic models (only when asked for)", lambda: [part.model for part in parts])
    console.print(table)
    kinds = ", ".join(
        f"{count} {kind}" for kind, count in sorted(Counter(n.kind for n in names).items())
    )
    sizes = sorted(results["JSON schemas"])
    console.print(
        f"derived {len(names) - len(failures)} of {len(names)} ({kinds}): {len(parts)} parts"
    )
    console.print(
        f"JSON schema: median {sizes[len(sizes) // 2]} bytes, largest {sizes[-1]} bytes\n"
    )
    for failure in failures:
        console.print(failure)
    return not failures


def fill_twist(value: dict[str, Any]) -> Any:
    """Hand-written floor; so are the other `fill_` functions."""
    from geometry_msgs.msg import Twist

    message = Twist()
    linear, angular = value["linear"], value["angular"]
    message.linear.x, message.linear.y, message.linear.z = linear["x"], linear["y"], linear["z"]
    message.angular.x, message.angular.y, message.angular.z = (
        angular["x"],
        angular["y"],
        angular["z"],
    )
    return message


def fill_array(value: dict[str, Any]) -> Any:
    from std_msgs.msg import Float64MultiArray

    message = Float64MultiArray()
    message.data = array("d", value["data"])
    return message


def fill_trajectory(value: dict[str, Any]) -> Any:
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    message = JointTrajectory()
    message.joint_names = value["joint_names"]
    for given in value["points"]:
        point = JointTrajectoryPoint()
        point.positions = array("d", given["positions"])
        point.time_from_start.sec = given["time_from_start"]["sec"]
        message.points.append(point)
    return message


def fill_image(value: dict[str, Any]) -> Any:
    from sensor_msgs.msg import Image

    message = Image()
    message.height, message.width, message.step = value["height"], value["width"], value["step"]
    message.encoding = value["encoding"]
    message.data = array("B", base64.b64decode(value["data"]))
    return message


def read_twist(message: Any) -> dict[str, Any]:
    return {k: {a: getattr(getattr(message, k), a) for a in "xyz"} for k in ("linear", "angular")}


AXES = {"x": 0.1, "y": 0.0, "z": -0.3}
CASES: tuple[tuple[str, str, dict[str, Any], Callable[[dict[str, Any]], Any]], ...] = (
    ("Twist", "geometry_msgs/msg/Twist", {"linear": AXES, "angular": AXES}, fill_twist),
    (
        "1000 float64",
        "std_msgs/msg/Float64MultiArray",
        {"data": [i * 0.5 for i in range(1000)]},
        fill_array,
    ),
    (
        "trajectory, 10 points of 7 joints",
        "trajectory_msgs/msg/JointTrajectory",
        {
            "joint_names": [f"joint_{i}" for i in range(7)],
            "points": [
                {"positions": [0.1] * 7, "time_from_start": {"sec": i, "nanosec": 0}}
                for i in range(10)
            ],
        },
        fill_trajectory,
    ),
    (
        "640x480 rgb8 image from base64",
        "sensor_msgs/msg/Image",
        {
            "height": 480,
            "width": 640,
            "step": 1920,
            "encoding": "rgb8",
            "data": base64.b64encode(bytes(480 * 1920)).decode(),
        },
        fill_image,
    ),
)


def median_us(work: Callable[[], Any], repeat: int) -> float:
    """Median wall time of one call [us]."""
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e6


def bench_calls(console: Console, repeat: int) -> None:
    """Encode and decode against hand-written code."""
    table = Table(title="One call, median", title_justify="left")
    for column in (
        "message",
        "checked encode [us]",
        "hand-written fill [us]",
        "ratio",
        "decode for agents [us]",
    ):
        table.add_column(column, justify="left" if column == "message" else "right")
    for label, name, value, fill in CASES:
        part = load_message(name)
        message = part.encode(value, now_ns=1)
        turns = max(20, repeat // (20 if "image" in label else 1))
        ours = median_us(partial(part.encode, value, now_ns=1), turns)
        floor = median_us(partial(fill, value), turns)
        decoded = median_us(partial(part.decode, message), turns)
        table.add_row(label, f"{ours:.1f}", f"{floor:.1f}", f"{ours / floor:.2f}", f"{decoded:.1f}")
    console.print(table)
    part = load_message("geometry_msgs/msg/Twist")
    message = part.encode(CASES[0][2], now_ns=1)
    ratio = median_us(lambda: part.decode(message), repeat) / median_us(
        lambda: read_twist(message), repeat
    )
    console.print(f"decode of a Twist is {ratio:.2f} times a hand-written read")


def main() -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeat", type=int, default=2000)
    console = Console(width=120)
    arguments = parser.parse_args()
    complete = bench_derive(console)
    bench_calls(console, arguments.repeat)
    return 0 if complete else 1


if __name__ == "__main__":
    sys.exit(main())
