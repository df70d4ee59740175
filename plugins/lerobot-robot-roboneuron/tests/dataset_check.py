"""Runs in lerobot's environment: opens a data set with lerobot and prints its contents as JSON."""

from __future__ import annotations

import json
import sys

from lerobot.datasets import LeRobotDataset

found = LeRobotDataset("me/arm", root=sys.argv[1])
rows = [found[i] for i in range(len(found))]
print(
    json.dumps(
        {
            "episodes": found.num_episodes,
            "fps": found.fps,
            "names": found.features["action"]["names"],
            "action": [row["action"].tolist() for row in rows],
            "state": [row["observation.state"].tolist() for row in rows],
            "episode": [int(row["episode_index"]) for row in rows],
            "images": {
                key: [list(rows[0][key].shape), float(rows[0][key].mean())]
                for key in found.features
                if key.startswith("observation.images")
            },
        }
    )
)
