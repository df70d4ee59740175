"""Runs in lerobot's environment: opens a data set with lerobot and writes its arrays.

dataset_arrays.py DATASET ARRAYS.npz
"""

from __future__ import annotations

import sys

import numpy as np
from lerobot.datasets import LeRobotDataset

found = LeRobotDataset("local/arm", root=sys.argv[1], video_backend="pyav")
rows = [found[i] for i in range(len(found))]
cameras = [key for key in found.features if key.startswith("observation.images")]
np.savez(
    sys.argv[2],
    fps=found.fps,
    episodes=found.num_episodes,
    timestamp=np.array([float(row["timestamp"]) for row in rows]),
    **{
        key: np.array([row[key].numpy() for row in rows], dtype=np.float64)
        for key in ("action", "observation.state")
    },
    **{
        f"{key}.names": np.array(found.features[key]["names"])
        for key in ("action", "observation.state")
    },
    **{key: np.array([row[key].numpy() * 255.0 for row in rows]) for key in cameras},
)
