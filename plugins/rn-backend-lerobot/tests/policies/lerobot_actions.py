"""LeRobot's own answer to one observation of a file, in its environment:

python lerobot_actions.py CHECKPOINT OBSERVATION.npz ACTIONS.npy COUNT
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from lerobot_loops import Synchronous

from roboneuron import Frame, JointSample, Observation


def main(checkpoint: str, source: str, target: str, count: str) -> None:
    """Write float64 (count, n): the actions of `SyncInferenceEngine` in `count` ticks."""
    seen = np.load(source)
    names = tuple(str(name) for name in seen["names"])
    frames = {
        camera: Frame(camera=camera, image=seen[camera], stamp_ns=1, frame_id="optical")
        for camera in ("front", "wrist")
    }
    observation = Observation(
        frames=frames,
        instruction=str(seen["instruction"]),
        joints=JointSample(names=names[:-1], position=seen["state"][:-1]),
        gripper_open=float(seen["state"][-1]),
    )
    engine = Synchronous(Path(checkpoint), names)
    torch.manual_seed(0)  # as for the option `seed`
    np.save(target, np.array([engine.act(observation) for _ in range(int(count))]))


if __name__ == "__main__":
    main(*sys.argv[1:])
