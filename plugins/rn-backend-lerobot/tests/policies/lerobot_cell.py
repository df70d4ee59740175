"""The robot of these tests, and what it sees."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import numpy as np

from rn_backend_lerobot.backend import LeRobotBackend
from rn_backend_lerobot.small_gemma import small_gemma
from roboneuron import Frame, JointSample, Observation

ARM = tuple(f"fr3_joint{i}" for i in range(1, 8))
NAMES = (*ARM, "gripper_open")
RATE_HZ = 20.0
PERIOD_NS = round(1e9 / RATE_HZ)
Load = Callable[..., LeRobotBackend]


@contextlib.contextmanager
def sizes_of(policy: str) -> Iterator[None]:
    """What has to be patched while a tiny policy is loaded."""
    with small_gemma() if policy == "pi05" else contextlib.nullcontext():
        yield


def observe(number: int, instruction: str = "pick up the red cube") -> Observation:
    """Observation of a number: noise as images, joints near those of the training data."""
    random = np.random.default_rng(number)
    stamp_ns = 10**9 + number * PERIOD_NS
    frames = {
        role: Frame(
            camera=camera,
            image=random.integers(0, 256, (96, 96, 3), dtype=np.uint8),
            stamp_ns=stamp_ns,
            frame_id=f"{camera}_optical",
        )
        for role, camera in (("primary", "front"), ("wrist", "wrist"))
    }
    home = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
    joints = JointSample(names=ARM, position=home + random.normal(0.0, 0.05, 7))
    return Observation(
        frames=frames,
        instruction=instruction,
        joints=joints,
        gripper_open=float(random.uniform(0.3, 0.7)),
        stamp_ns=stamp_ns,
    )
