"""The robot of these tests, and its observations."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from rn_backend_lerobot.backend import LeRobotBackend
from rn_backend_lerobot.small_gemma import small_gemma
from rn_backend_lerobot.tiny import PATCHED
from roboneuron import ArmState, Frame, JointSample, Observation, Pose

ARM = tuple(f"fr3_joint{i}" for i in range(1, 8))
NAMES = (*ARM, "gripper_open")
SIDES = ("left", "right")
PAIR = {
    f"{side}_{joint}": {"to": f"{side}/{side}_{joint}", "unit": "radians"}
    for side in SIDES
    for joint in ARM
} | {f"{side}_gripper": {"to": f"{side}/gripper_open", "unit": "open_fraction"} for side in SIDES}
"""Numbers of two arms by the names of a data set: joints of both, then grippers."""
ORIGIN = Pose(position_m=np.zeros(3), quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))
RATE_HZ = 20.0
PERIOD_NS = round(1e9 / RATE_HZ)
Load = Callable[..., LeRobotBackend]


@contextlib.contextmanager
def sizes_of(policy: str) -> Iterator[None]:
    """Patches needed while a tiny policy is loaded."""
    with small_gemma() if policy in PATCHED else contextlib.nullcontext():
        yield


def observe(number: int, instruction: str = "pick up the red cube") -> Observation:
    """Observation with this number: noise as images, joints near those of the training data."""
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


def observe_pair(number: int) -> Observation:
    """As `observe`, for two arms in different positions."""
    one, other = observe(number), observe(number + 1000)
    assert one.joints is not None
    assert other.joints is not None
    names = tuple(f"{side}_{joint}" for side in SIDES for joint in ARM)
    position = np.concatenate([one.joints.position, other.joints.position])
    arms = {
        side: ArmState(ee_pose=ORIGIN, gripper_open=seen.gripper_open)
        for side, seen in zip(SIDES, (one, other), strict=True)
    }
    joints = JointSample(names=names, position=position)
    return replace(one, joints=joints, gripper_open=None, arms=arms)
