"""Program that writes a data set with lerobot's own writer, for an interpreter with lerobot but
without ROS and RoboNeuron.

Stdin contains one line of JSON with `root`, `fps`, `features`, `robot_type` and `codec`; then for
each episode `T` and a line with its instruction, for each row `F` and the bytes of its features in
their order, and `E`. Exits with 3 without a supported lerobot.
"""

from __future__ import annotations

import json
import math
import sys
from typing import Any, BinaryIO

import numpy as np

VERSION = "0.6."
"""Supported version of lerobot, whose writer was tested."""


def read_row(stream: BinaryIO, features: dict[str, dict[str, Any]]) -> dict[str, object]:
    """The values of one row by feature."""
    row: dict[str, object] = {}
    for name, feature in features.items():
        kind = np.dtype("uint8" if feature["dtype"] == "video" else feature["dtype"])
        data = stream.read(kind.itemsize * math.prod(feature["shape"]))
        row[name] = np.frombuffer(data, kind).reshape(feature["shape"])
    return row


def main(stream: BinaryIO) -> None:
    """Write the rows from the stream."""
    try:
        import lerobot
        from lerobot.configs import RGBEncoderConfig
        from lerobot.datasets.lerobot_dataset import (
            LeRobotDataset,
        )
    except ImportError as error:
        print(error, file=sys.stderr)
        sys.exit(3)
    if not lerobot.__version__.startswith(VERSION):
        print(f"lerobot is {lerobot.__version__}, not {VERSION}x", file=sys.stderr)
        sys.exit(3)
    about = json.loads(stream.readline())
    features = {
        name: {**feature, "shape": tuple(feature["shape"])}
        for name, feature in about["features"].items()
    }
    dataset = LeRobotDataset.create(
        repo_id="local/roboneuron",
        root=about["root"],
        fps=about["fps"],
        features=features,
        robot_type=about["robot_type"],
        rgb_encoder=RGBEncoderConfig(vcodec=about["codec"]),
    )
    task = ""
    while mark := stream.read(1):
        if mark == b"T":
            task = json.loads(stream.readline())
        elif mark == b"F":
            dataset.add_frame({**read_row(stream, features), "task": task})
        else:
            dataset.save_episode(parallel_encoding=False)
    dataset.finalize()


if __name__ == "__main__":
    main(sys.stdin.buffer)
