"""MoveIt goals for an FR3, and the limits that they are checked against."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD, profile
from roboneuron import (
    Endpoint,
    JointSample,
)
from roboneuron.config import LimitsConfig
from roboneuron.feature import motion_rules
from roboneuron.gate.motion.path_limits import PathLimiter

EXAMPLES = Path(__file__).parents[1] / "examples"
MOVE, EXECUTE = "moveit_msgs/action/MoveGroup", "moveit_msgs/action/ExecuteTrajectory"
BASE, TCP = "fr3_link0", "fr3_hand_tcp"
HOME = JointSample(names=ARM_JOINTS, position=np.array(HOME_RAD))
CUP = {"name": "cup", "lower_m": [0.45, 0.15, 0.0], "upper_m": [0.55, 0.25, 0.3]}
LIMITS = {"velocity_fraction": 0.5, "acceleration_fraction": 0.4, "zones": [CUP]}


def joint_goal(**changed: float) -> dict[str, Any]:
    """Constraints for every joint, relative to home."""
    at = dict(zip(ARM_JOINTS, HOME_RAD, strict=True)) | changed
    tolerances = {"tolerance_above": 0.001, "tolerance_below": 0.001}
    return {
        "joint_constraints": [
            {"joint_name": name, "position": float(position), **tolerances, "weight": 1.0}
            for name, position in at.items()
        ]
    }


def place_goal(x: float, y: float, z: float, radius_m: float = 0.005) -> dict[str, Any]:
    """Constraints for the TCP in a ball, with the hand straight down."""
    header = {"frame_id": BASE}
    region = {
        "primitives": [{"type": 2, "dimensions": [radius_m]}],
        "primitive_poses": [{"position": {"x": x, "y": y, "z": z}}],
    }
    turn = {"x": 1.0, "w": 0.0}
    return {
        "position_constraints": [
            {"header": header, "link_name": TCP, "constraint_region": region, "weight": 1.0}
        ],
        "orientation_constraints": [
            {"header": header, "link_name": TCP, "orientation": turn, "weight": 1.0}
        ],
    }


def goal_of(*constraints: dict[str, Any]) -> dict[str, Any]:
    """A valid goal of MoveGroup."""
    return {
        "request": {
            "group_name": "fr3_arm",
            "start_state": {"is_diff": True},
            "goal_constraints": list(constraints),
            "max_velocity_scaling_factor": 0.3,
            "max_acceleration_scaling_factor": 0.3,
            "allowed_planning_time": 2.0,
        },
        "planning_options": {
            "planning_scene_diff": {"is_diff": True, "robot_state": {"is_diff": True}}
        },
    }


def endpoint(type_name: str = MOVE, **changes: Any) -> Endpoint:
    kept = {"name": "arm", "kind": "action", "topic": "/move", "summary": "", "joint_limited": True}
    return Endpoint(**{**kept, "type": type_name, **changes})


def trajectory(*rows: tuple[float, float]) -> dict[str, Any]:
    """Displacements of the last joint from home, at these times [s]."""
    points = [
        {
            "positions": [*HOME_RAD[:6], HOME_RAD[6] + step],
            "time_from_start": {"sec": int(at_s), "nanosec": round(at_s % 1 * 1e9)},
        }
        for step, at_s in rows
    ]
    return {"trajectory": {"joint_trajectory": {"joint_names": list(ARM_JOINTS), "points": points}}}


def limiter_of_fr3() -> PathLimiter:
    """A limiter for paths of an FR3 with LIMITS."""
    facts = profile()
    controller = UrdfController(None, facts)
    controller.load()
    rules = motion_rules(LimitsConfig.model_validate(LIMITS), facts)
    return PathLimiter(rules, facts, controller.inspect)
