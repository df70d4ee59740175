"""Statistics of tiny checkpoints: plausible numbers for the states and actions of a profile."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from rn_backend_pi0.architecture import Variant
from rn_backend_pi0.joint_layout import JointLayout
from rn_backend_pi0.profiles import JOINT_PROFILES

Block: TypeAlias = dict[str, list[float]]
TINY_PROFILES = ("libero", *JOINT_PROFILES)
"""Profiles for which there are tiny checkpoints."""
_TCP_STATE = {
    "mean": [0.45, 0.0, 0.45, float(np.pi), 0.0, 0.0, 0.02, -0.02],
    "std": [0.2, 0.2, 0.2, 0.3, 0.3, 0.3, 0.02, 0.02],
}
_TCP_ACTION = {"mean": [0.0] * 7, "std": [0.15, 0.15, 0.15, 0.03, 0.03, 0.03, 0.6]}
_BENT_RAD = {6: (0.0, -1.57, 1.57, -1.57, -1.57, 0.0), 7: (0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8)}
"""Postures around which tiny policies of six and seven joints move."""
_STEP_RAD = 0.02
_QUANTILE = 2.326
"""Standard deviations from the mean to the 1st and 99th percentile of a normal distribution."""


def tiny_statistics(profile: str, variant: Variant) -> tuple[Block, Block]:
    """Statistics of state and actions: "mean" and "std", for pi0.5 and pi0-FAST also "q01" and
    "q99".
    """
    if profile in JOINT_PROFILES:
        state, action = _joints(JOINT_PROFILES[profile])
    else:
        state, action = dict(_TCP_STATE), dict(_TCP_ACTION)
    if variant != "pi0":
        for block in (state, action):
            mean, half = np.array(block["mean"]), _QUANTILE * np.array(block["std"])
            block |= {"q01": (mean - half).tolist(), "q99": (mean + half).tolist()}
    return state, action


def _joints(layout: JointLayout) -> tuple[Block, Block]:
    posture = _BENT_RAD[layout.joints]
    still = (0.0,) * layout.joints
    moving = layout.relative or layout.kind == "joint_velocity"
    state = _arms(layout, posture, joint_std=0.5)
    action = _arms(layout, still if moving else posture, joint_std=_STEP_RAD)
    return state, action


def _arms(layout: JointLayout, joints: Sequence[float], *, joint_std: float) -> Block:
    count = len(layout.arms)
    return {
        "mean": [*joints, 0.5] * count,
        "std": [*(joint_std,) * layout.joints, 0.3] * count,
    }
