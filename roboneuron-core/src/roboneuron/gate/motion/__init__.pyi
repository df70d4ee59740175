"""The names of the package by the modules that define them; see `roboneuron.contract`."""

# ruff: noqa: I001
from .command import (
    LimitedCommand as LimitedCommand,
)
from .driver_limits import (
    MOST_POINTS as MOST_POINTS,
    DriverLimiter as DriverLimiter,
)
from .driver_paths import (
    DriverPaths as DriverPaths,
)
from .limiter import (
    MotionLimiter as MotionLimiter,
)
from .rules import (
    LIMITS as LIMITS,
    MotionRules as MotionRules,
    check_tighter as check_tighter,
    collision_of as collision_of,
    inspector_of as inspector_of,
    motion_rules as motion_rules,
    poses_of as poses_of,
)
from .task_space import (
    Motion as Motion,
)
