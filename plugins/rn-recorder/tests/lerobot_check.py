"""Opens a data set with lerobot itself and compares it with the MCAP files that it was made of.

Run by the interpreter of .venv-lerobot, which has lerobot 0.6.1 and neither ROS nor RoboNeuron:
    lerobot_check.py DATASET EXPECTED

EXPECTED is a folder with one .npz for each episode, in their order: `action` (n, 7) float64,
`state` (n, j), `sent_ns`, `image_ns` (n,), `task` (one string), and (n, H, W, 3) uint8 for each
`observation.images.<camera>`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

MOST_ERROR = 6.0
"""Of a frame's mean difference, of 255: what the codec may take."""
TOLD_APART = 2.0
"""Neighbours that differ by more than this must be told apart behind the codec."""


def main(root: str, expected: str) -> None:
    """Compare; raises AssertionError."""
    dataset = LeRobotDataset("local/demos", root=root, video_backend="pyav")
    episodes = sorted(Path(expected).glob("*.npz"))
    assert dataset.num_episodes == len(episodes), (dataset.num_episodes, len(episodes))
    # as tensors lerobot makes float32 of them
    exact = dataset.hf_dataset.with_format(None)["roboneuron.action"]
    index, worst, told_apart = 0, 0.0, 0
    for number, path in enumerate(episodes):
        with np.load(path) as file:
            wanted = dict(file)
        before = index
        for frame in range(len(wanted["action"])):
            row = dataset[index]
            where = (number, frame)
            assert (int(row["episode_index"]), int(row["frame_index"]), int(row["index"])) == (
                number,
                frame,
                index,
            )
            assert np.array_equal(np.array(exact[index]), wanted["action"][frame]), where
            assert np.array_equal(
                row["action"].numpy(), wanted["action"][frame].astype(np.float32)
            ), where
            assert np.array_equal(
                row["observation.state"].numpy(), wanted["state"][frame].astype(np.float32)
            ), where
            assert int(row["roboneuron.sent_ns"]) == wanted["sent_ns"][frame], where
            assert int(row["roboneuron.seen_ns"]) == wanted["image_ns"][frame], where
            assert row["task"] == str(wanted["task"]), where
            assert np.isclose(float(row["timestamp"]), frame / dataset.fps, atol=1e-6), where
            for camera in dataset.meta.video_keys:
                shown = row[camera].numpy().transpose(1, 2, 0) * 255.0
                error = _difference(shown, wanted[camera][frame])
                worst = max(worst, error)
                neighbour = wanted[camera][frame - 1 if frame else 1]
                if _difference(neighbour, wanted[camera][frame]) > TOLD_APART:
                    assert error < _difference(shown, neighbour), (*where, camera)
                    told_apart += 1
            index += 1
        print(f"episode {number}: {index - before} frames", file=sys.stderr, flush=True)
    assert dataset.num_frames == index, (dataset.num_frames, index)
    assert worst < MOST_ERROR, f"a video frame differs by {worst} of 255 on average"
    print(
        f"{len(episodes)} episodes, {index} frames equal; video within {worst:.2f} of 255, "
        f"{told_apart} told apart"
    )


def _difference(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.abs(first.astype(np.float32) - second.astype(np.float32)).mean())


if __name__ == "__main__":
    main(*sys.argv[1:])
