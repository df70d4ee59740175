"""Opens a data set with lerobot itself and compares it with the MCAP files that it was made of.

Run by the interpreter of .venv-lerobot, which has lerobot 0.6.1 and neither ROS nor RoboNeuron:
    lerobot_check.py DATASET EXPECTED.npz
"""

from __future__ import annotations

import sys

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset


def main(root: str, expected_path: str) -> None:
    """Compare; raises AssertionError."""
    with np.load(expected_path) as file:
        expected = dict(file)
    dataset = LeRobotDataset("local/demos", root=root, video_backend="pyav")
    assert dataset.num_episodes == int(expected["episodes"]), dataset.num_episodes
    assert dataset.num_frames == len(expected["action"]), dataset.num_frames
    cameras = list(dataset.meta.video_keys)
    worst = 0.0
    exact = dataset.hf_dataset.with_format(None)["roboneuron.action"]  # as tensors lerobot makes float32 of them
    for index in range(dataset.num_frames):
        row = dataset[index]
        assert np.array_equal(np.array(exact[index]), expected["action"][index]), index
        assert np.array_equal(row["action"].numpy(), expected["action"][index].astype(np.float32)), index
        assert int(row["roboneuron.sent_ns"]) == expected["sent_ns"][index], index
        assert int(row["roboneuron.image_ns"]) == expected["image_ns"][index], index
        assert row["task"] == str(expected["task"][index]), index
        assert np.isclose(float(row["timestamp"]), expected["frame_index"][index] / dataset.fps, atol=1e-6), index
        for camera in cameras:
            image = row[camera].numpy().transpose(1, 2, 0) * 255.0
            worst = max(worst, float(np.abs(image - expected[camera][index]).mean()))
    assert worst < 6.0, f"a video frame differs by {worst} of 255 on average"
    print(f"{dataset.num_episodes} episodes, {dataset.num_frames} frames equal; video within {worst:.2f} of 255")


if __name__ == "__main__":
    main(*sys.argv[1:])
