"""Robot profiles with one mistake each."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from mutation import (
    Mutant,
)

from rn_testing.fakes import gantry_profile
from roboneuron.contract import CameraCalibration, Endpoint, Workspace

GOOD = gantry_profile()
CALLS = itertools.count()


def profiled(rule, words="", **changes):
    """A profile with some changed fields."""
    return Mutant(
        rule=f"robot/{rule}", target=lambda: replace(gantry_profile(), **changes), words=words
    )


def limited(rule, words="", **changes):
    return profiled(rule, words, limits=replace(GOOD.limits, **changes))


def camera(words="", **changes):
    fields = {
        "intrinsics": np.array([[64, 0, 32], [0, 64, 24], [0, 0, 1.0]]),
        "mount": "base",
        "T_mount_camera": np.eye(4),
    }
    calibration = CameraCalibration(**{**fields, **changes})
    cameras = (replace(GOOD.cameras[0], calibration=calibration), GOOD.cameras[1])
    return profiled("cameras-agree", words, cameras=cameras)


def endpoint(**changes):
    return profiled("endpoints-usable", endpoints=(replace(GOOD.endpoints[0], **changes),))


def moved(x_m):
    pose = np.eye(4)
    pose[0, 3] = x_m
    return pose


PROFILES: dict[str, Mutant] = {
    "dictionary": Mutant(rule="robot/profile-named", target=lambda: {"name": "gantry"}),
    "another_name": profiled("profile-named", name="other"),
    "limits_missing": profiled("limits-sane", limits=None),
    "limits_crossed": limited("limits-sane", lower=GOOD.limits.upper, upper=GOOD.limits.lower),
    "limits_of_two_joints": limited("limits-sane", velocity=np.ones(2)),
    "limits_of_nan": limited("limits-sane", upper=np.full(6, np.nan)),
    "limits_infinite": limited("limits-sane", upper=np.full(6, np.inf)),
    "velocity_limit_of_zero": limited("limits-sane", velocity=np.zeros(6)),
    "effort_negative": limited("limits-sane", effort=-np.ones(6)),
    "joints_missing": profiled("limits-sane", arm_joints=()),
    "joint_twice": profiled("limits-sane", arm_joints=("slide_x", "slide_x", *GOOD.arm_joints[2:])),
    "limits_in_degrees": limited(
        "limits-of-urdf", lower=np.degrees(GOOD.limits.lower), upper=np.degrees(GOOD.limits.upper)
    ),
    "limits_in_millimetres": limited(
        "limits-of-urdf", upper=GOOD.limits.upper * [1000, 1000, 1000, 1, 1, 1]
    ),
    "velocity_in_degrees": limited("limits-of-urdf", velocity=np.degrees(GOOD.limits.velocity)),
    "limits_in_another_order": limited(
        "limits-of-urdf", lower=GOOD.limits.lower[::-1], upper=GOOD.limits.upper[::-1]
    ),
    "gripper_in_millimetres": profiled(
        "limits-of-urdf", "gripper", gripper=replace(GOOD.gripper, open_position=40.0)
    ),
    "home_outside": profiled("home-inside", home_rad=np.full(6, 50.0)),
    "home_missing": profiled("home-inside", home_rad=None),
    "home_in_degrees": profiled("home-inside", home_rad=np.degrees(GOOD.home_rad)),
    "home_of_five_joints": profiled("home-inside", home_rad=GOOD.home_rad[:5]),
    "urdf_missing": profiled("urdf-complete", urdf=""),
    "urdf_torn": profiled("urdf-complete", "not valid XML", urdf="<robot>"),
    "tcp_not_in_the_urdf": profiled("urdf-complete", tcp_link="tool"),
    "base_not_in_the_urdf": profiled("urdf-complete", base_link="world"),
    "joint_not_in_the_urdf": profiled("urdf-complete", arm_joints=("elbow", *GOOD.arm_joints[1:])),
    "joints_from_tip_to_base": profiled("urdf-complete", "tip", arm_joints=GOOD.arm_joints[::-1]),
    "joint_left_out": profiled("urdf-complete", "lacks", arm_joints=GOOD.arm_joints[:5]),
    "camera_not_declared": profiled("cameras-agree", cameras=GOOD.cameras[:1]),
    "camera_of_another_role": profiled(
        "cameras-agree", cameras=(replace(GOOD.cameras[0], role="wrist"), GOOD.cameras[1])
    ),
    "camera_without_frame": profiled(
        "cameras-agree", cameras=(replace(GOOD.cameras[0], frame_id=""), GOOD.cameras[1])
    ),
    "camera_without_pixels": profiled(
        "cameras-agree", cameras=(replace(GOOD.cameras[0], width=0), GOOD.cameras[1])
    ),
    "camera_pose_in_millimetres": camera("millimetres", T_mount_camera=moved(500.0)),
    "camera_mirrored": camera("not a pose", T_mount_camera=np.diag([1, 1, -1, 1.0])),
    "camera_pose_transposed": camera("not a pose", T_mount_camera=moved(0.5).T),
    "camera_on_another_mount": camera("mount", mount="wrist"),
    "camera_centre_in_metres": camera(
        "centre", intrinsics=np.array([[64, 0, -0.3], [0, 64, 0.2], [0, 0, 1]])
    ),
    "camera_focal_length_zero": camera(
        "focal", intrinsics=np.array([[0, 0, 32], [0, 0, 24], [0, 0, 1.0]])
    ),
    "gripper_stuck": profiled("gripper-travels", gripper=replace(GOOD.gripper, open_position=0.0)),
    "workspace_empty": profiled(
        "workspace-not-empty", workspace=Workspace(lower_m=np.ones(3), upper_m=np.zeros(3))
    ),
    "workspace_without_home": profiled(
        "home-in-workspace", workspace=Workspace(lower_m=np.full(3, 0.8), upper_m=np.ones(3))
    ),
    "workspace_in_millimetres": profiled(
        "home-in-workspace",
        workspace=Workspace(lower_m=np.array([300.0, -500, 0]), upper_m=np.full(3, 900.0)),
    ),
    "profile_changes": Mutant(
        rule="robot/profile-stable",
        target=lambda: replace(gantry_profile(), home_rad=GOOD.home_rad + 1e-3 * next(CALLS)),
    ),
    "base_with_an_arm": Mutant(
        rule="robot/kind-agrees", spec={"robot_kind": "base", "action_widths": ()}
    ),
    "arm_without_widths": Mutant(rule="robot/kind-agrees", spec={"action_widths": ()}),
    "endpoint_of_another_type": endpoint(type="sensor_msgs/srv/JointState"),
    "endpoint_of_an_unknown_kind": endpoint(kind="subscribe"),
    "endpoint_in_camel_case": endpoint(name="jointStates"),
    "endpoint_without_summary": endpoint(summary=" "),
    "endpoint_with_bounds_crossed": endpoint(bounds={"position": (1.0, -1.0)}),
    "endpoint_with_bounds_of_nan": endpoint(bounds={"position": (float("nan"), 1.0)}),
    "endpoint_twice": profiled("endpoints-usable", endpoints=2 * GOOD.endpoints),
    "endpoint_without_a_package": profiled(
        "endpoints-usable",
        endpoints=(Endpoint(name="a", kind="read", topic="a", type="JointState", summary="A."),),
    ),
}

# the prefix distinguishes them from the functions above
MUTANTS = {f"profile_{n}": m for n, m in PROFILES.items()}


def __getattr__(name):
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
