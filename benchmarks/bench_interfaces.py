"""Encoding and decoding of types created at run time compared with the compiled ones, interleaved.

    python benchmarks/bench_interfaces.py [--rounds 30]

Prints, for a JointState of seven joints and an image of 640x480, the smallest thread time in
microseconds and the ratio. The definitions are those of the wheels, learnt under another package
name.
"""

from __future__ import annotations

import argparse
import array
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

WORDS = ("JointState", "Image")
CALLS = {"JointState": 500, "Image": 20}
"""Calls in each turn."""


def fill(message: Any) -> Any:
    """Fill a message of either package with the measured values."""
    message.header.frame_id = "base"
    if hasattr(message, "encoding"):
        message.height, message.width, message.step = 480, 640, 1920
        message.encoding = "rgb8"
        message.data = array.array("B", bytes(640 * 480 * 3))
        return message
    message.name = [f"fr3_joint{number}" for number in range(1, 8)]
    for field in ("position", "velocity", "effort"):
        setattr(message, field, array.array("d", range(7)))
    return message


def learn_copies(scratch: Path) -> None:
    """Learn the measured messages as those of a package `bench_msgs`."""
    os.environ["XDG_DATA_HOME"] = str(scratch / "data")
    os.environ["XDG_CACHE_HOME"] = str(scratch / "cache")
    from rn_interfaces.finder import install
    from rn_interfaces.found import FoundDefinition, FoundDefinitions
    from rn_interfaces.learning import learn
    from rn_interfaces.store import DefinitionStore, Name

    install()
    share = Path(sys.prefix) / "share" / "sensor_msgs" / "msg"
    texts = {
        Name("bench_msgs", "msg", word): FoundDefinition(
            (share / f"{word}.msg").read_text(), "the wheels"
        )
        for word in WORDS
    }
    learn(DefinitionStore(), FoundDefinitions(texts=texts))


def least_us(rounds: int, calls: int, functions: Sequence[Callable[[], object]]) -> list[float]:
    """Smallest thread time of each function [us], interleaved."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(rounds):
        for number, function in enumerate(functions):
            begun = time.thread_time()
            for _ in range(calls):
                function()
            times[number].append((time.thread_time() - begun) / calls * 1e6)
    return [min(one) for one in times]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=30)
    rounds = parser.parse_args().rounds
    with TemporaryDirectory() as scratch:
        learn_copies(Path(scratch))
        from rclpy.serialization import deserialize_message, serialize_message

        print(f"{'':24}{'compiled us':>12}{'run time us':>12}{'ratio':>7}")
        for word in WORDS:
            classes = [
                getattr(import_module(f"{package}.msg"), word)
                for package in ("sensor_msgs", "bench_msgs")
            ]
            messages = [fill(cls()) for cls in classes]
            data = serialize_message(messages[0])
            encode = [partial(serialize_message, one) for one in messages]
            decode = [partial(deserialize_message, data, cls) for cls in classes]
            for what, functions in (("encode", encode), ("decode", decode)):
                compiled, made = least_us(rounds, CALLS[word], functions)
                print(f"{word + ' ' + what:24}{compiled:12.1f}{made:12.1f}{made / compiled:7.2f}")


if __name__ == "__main__":
    main()
