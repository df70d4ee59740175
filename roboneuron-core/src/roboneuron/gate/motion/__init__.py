"""Limits on how an arm moves, for the commands of control and for joint motions: pure computation,
numpy only.
"""

from roboneuron.gate.motion.command import LimitedCommand
from roboneuron.gate.motion.limiter import MotionLimiter
from roboneuron.gate.motion.rules import (
    LIMITS,
    MotionRules,
    check_tighter,
    collision_of,
    inspector_of,
    motion_rules,
    poses_of,
)
from roboneuron.gate.motion.task_space import Motion

__all__ = [
    "LIMITS",
    "LimitedCommand",
    "Motion",
    "MotionLimiter",
    "MotionRules",
    "check_tighter",
    "collision_of",
    "inspector_of",
    "motion_rules",
    "poses_of",
]
