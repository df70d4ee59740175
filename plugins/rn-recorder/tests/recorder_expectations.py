"""What a data set must hold of a recorded demonstration, read by MCAP's own reader and none of the
exporter's code.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory


def expected_episode(path: Path) -> dict[str, Any]:
    """The rows of a file with one episode, as `lerobot_check.py` wants them.

    A row is an action. Its images and joints are those that the prediction before it names, or for
    further actions of the same prediction the newest.
    """
    pictures: dict[str, dict[int, np.ndarray]] = {}
    newest: dict[str, int] = {}
    rows: dict[str, list[Any]] = {"action": [], "state": [], "sent_ns": [], "image_ns": []}
    joints: list[float] = []
    seen: dict[str, Any] | None = None
    task = ""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            topic = channel.topic.split("/")
            if topic[-1] == "image":
                stamp_ns = decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec
                pixels = np.frombuffer(decoded.data, dtype=np.uint8).reshape(
                    decoded.height, decoded.width, 3
                )
                pictures.setdefault(topic[-2], {})[stamp_ns] = pixels
                newest[topic[-2]] = stamp_ns
            elif topic[-1] == "joint_states":
                joints = list(decoded.position)
            elif topic[-1] == "predictions":
                seen = json.loads(decoded.data)
                task = seen["instruction"]
            elif topic[-1] == "action":
                stamps = dict(newest)
                if seen is not None:
                    stamps |= {
                        frame["camera"]: frame["stamp_ns"] for frame in seen["frames"].values()
                    }
                rows["state"].append(joints if seen is None else seen["joints"]["position"])
                seen = None
                rows["action"].append(list(decoded.data))
                rows["sent_ns"].append(message.publish_time)
                rows["image_ns"].append(next(iter(stamps.values())))
                for camera, stamp_ns in stamps.items():
                    rows.setdefault(f"observation.images.{camera}", []).append(
                        pictures[camera][stamp_ns]
                    )
    return {"task": task, **{name: np.array(values) for name, values in rows.items()}}
