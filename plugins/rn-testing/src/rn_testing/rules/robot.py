"""Rules of robot profiles: limits, names, cameras and endpoints are consistent with each other and
with the descriptor.
"""

from __future__ import annotations

import re

import numpy as np

from rn_standard.declared_arm.urdf_joints import MOVABLE
from rn_testing.cases import RobotCase
from rn_testing.kinematics import place_tcp, read_chain, read_joints
from rn_testing.rule import NotApplicable, Rule, Violation, require
from rn_testing.snapshots import snapshot
from roboneuron import CameraCalibration, CameraProfile, RobotProfile

ENDPOINT_KINDS = ("publish", "read", "service", "action")
"""Values of `Endpoint.kind`."""
_ENDPOINT_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
MOUNTS = ("base", "tcp")
"""Values of `CameraCalibration.mount`; for several arms also "<arm>/tcp"."""
FARTHEST_CAMERA_M = 20.0
"""Maximum distance of a camera from its mount [m]."""
SLACK = 1e-3
"""Tolerance of a limit beyond the URDF's, for rounding [rad or m]; relative for velocities."""
_INTERFACE = {"publish": "msg", "read": "msg", "service": "srv", "action": "action"}


def _check_name(case: RobotCase) -> None:
    name = case.profile().name
    require(
        name == case.spec.name, f"the profile is named {name!r}, the descriptor {case.spec.name!r}"
    )


def _arm(case: RobotCase) -> RobotProfile:
    if case.spec.robot_kind != "arm":
        raise NotApplicable(f"the robot is of kind {case.spec.robot_kind!r}")
    return case.profile()


def _check_base(case: RobotCase) -> None:
    if case.spec.robot_kind != "base":
        require(bool(case.spec.action_widths), "the descriptor of an arm names no action_widths")
        return
    profile = case.profile()
    require(
        not profile.arm_joints and profile.gripper is None,
        "a base has the joints or the gripper of an arm",
    )


def _check_limits(case: RobotCase) -> None:
    profile = _arm(case)
    limits, count = profile.limits, len(profile.arm_joints)
    require(count > 0, "an arm has no arm_joints")
    require(len(set(profile.arm_joints)) == count, "an arm has two arm_joints of one name")
    if limits is None:
        raise Violation("an arm has no limits")
    turning = profile.kinds.continuous  # these may have no position limits
    for name in ("lower", "upper", "velocity", "acceleration", "effort"):
        values = getattr(limits, name)
        require(
            values.shape == (count,), f"limits.{name} has shape {values.shape}, expected ({count},)"
        )
        endless = [name in ("lower", "upper") and n in turning for n in profile.arm_joints]
        good = np.isfinite(values) | (np.array(endless) & ~np.isnan(values))
        require(bool(good.all()), f"limits.{name} holds a value that is not finite")
    require(bool((limits.lower < limits.upper).all()), "a lower limit is not below its upper limit")
    for name in ("velocity", "acceleration", "effort"):
        require(
            bool((getattr(limits, name) > 0).all()),
            f"limits.{name} holds a value that is not positive",
        )


def _check_home(case: RobotCase) -> None:
    profile = _arm(case)
    home, limits = profile.home_rad, profile.limits
    if home is None or limits is None:
        raise Violation("an arm has no home posture or no limits")
    require(
        home.shape == limits.lower.shape,
        f"home_rad has shape {home.shape}, expected {limits.lower.shape}",
    )
    inside = (limits.lower <= home) & (home <= limits.upper)
    outside = [n for n, ok in zip(profile.arm_joints, inside.tolist(), strict=True) if not ok]
    require(not outside, f"home is outside the limits of {', '.join(outside)}")


def _check_urdf(case: RobotCase) -> None:
    robot = _arm(case)
    require(bool(robot.urdf), "an arm has no URDF")
    for arm in robot.each_arm:
        _check_chain(robot.of_arm(arm))


def _check_chain(profile: RobotProfile) -> None:
    chain = read_chain(profile)
    movable = [joint.name for joint in chain if joint.kind in MOVABLE]
    astray = [n for n in profile.arm_joints if n not in movable]
    require(
        not astray,
        "arm_joints that are not movable joints between base and TCP in the URDF: "
        f"{', '.join(astray)}",
    )
    left_out = [n for n in movable if n not in profile.arm_joints]
    require(
        not left_out,
        f"arm_joints lacks joints between base and TCP in the URDF: {', '.join(left_out)}",
    )
    require(
        list(profile.arm_joints) == movable,
        f"arm_joints are not from base to tip: {', '.join(movable)}",
    )


def _check_urdf_limits(case: RobotCase) -> None:
    """The profile must be within the URDF's limits, which also detects degrees and millimetres."""
    profile = _arm(case)
    limits = profile.limits
    joints = {joint.name: joint for _, joint in read_joints(profile.urdf).values()}
    if limits is None:
        raise Violation("an arm has no limits")
    for index, name in enumerate(profile.arm_joints):
        if name not in joints:
            raise Violation(f"the URDF has no joint {name!r}")
        joint = joints[name]
        low, high, velocity = (
            float(v[index]) for v in (limits.lower, limits.upper, limits.velocity)
        )
        inside = joint.lower - SLACK <= low and high <= joint.upper + SLACK
        wanted = f"{joint.lower:g} .. {joint.upper:g}"
        require(
            inside or joint.kind == "continuous",
            f"{name} may go {low:g} .. {high:g}, in the URDF {wanted}",
        )
        told = f"{name} may move at {velocity:g} per second, in the URDF at {joint.velocity:g}"
        require(velocity <= joint.velocity * (1 + SLACK) or joint.velocity == 0, told)
    for gripper in profile.grippers:
        if gripper.joint not in joints:
            continue
        joint = joints[gripper.joint]
        for position in (gripper.closed_position, gripper.open_position):
            inside = joint.lower - SLACK <= position <= joint.upper + SLACK
            require(
                inside,
                f"the gripper goes to {position:g}, in the URDF {joint.lower:g} .. {joint.upper:g}",
            )


def _check_home_pose(case: RobotCase) -> None:
    profile = _arm(case)
    if profile.workspace is None or profile.home_rad is None:
        raise NotApplicable("the robot has no workspace or no home posture")
    positions = dict(zip(profile.arm_joints, profile.home_rad.tolist(), strict=True))
    lower_m, upper_m = profile.workspace.lower_m, profile.workspace.upper_m
    for arm in profile.each_arm:
        place = place_tcp(profile.of_arm(arm), positions).position_m
        inside = bool(((lower_m <= place) & (place <= upper_m)).all())
        require(inside, f"at home the TCP is at {place.round(3)} m, outside of the workspace")


def _check_stable(case: RobotCase) -> None:
    require(
        snapshot(case.profile()) == snapshot(case.profile()),
        "two calls of `target` return different profiles",
    )


def _check_cameras(case: RobotCase) -> None:
    profile = case.profile()
    declared = {(c.name, c.role) for c in case.spec.cameras}
    actual = {(c.name, c.role) for c in profile.cameras}
    require(
        declared == actual,
        f"the descriptor declares the cameras {sorted(declared)}, the profile {sorted(actual)}",
    )
    for camera in profile.cameras:
        require(bool(camera.frame_id), f"camera {camera.name!r} has no frame_id")
        require(
            camera.width > 0 and camera.height > 0,
            f"camera {camera.name!r} is {camera.width}x{camera.height}",
        )
        if camera.calibration is not None:
            _check_calibration(profile, camera, camera.calibration)


def _check_calibration(
    profile: RobotProfile, camera: CameraProfile, calibration: CameraCalibration
) -> None:
    """Check for a pinhole with its centre inside the image, mounted with a valid pose some metres
    away.
    """
    who = f"the calibration of camera {camera.name!r}"
    intrinsics, pose = calibration.intrinsics, calibration.T_mount_camera
    require(
        intrinsics.shape == (3, 3) and pose.shape == (4, 4),
        f"{who} has shapes {intrinsics.shape}, {pose.shape}",
    )
    require(bool(np.isfinite(intrinsics).all() and np.isfinite(pose).all()), f"{who} is not finite")
    mounts = (*MOUNTS, *(f"{arm.name}/tcp" for arm in profile.arms))
    require(
        calibration.mount in mounts,
        f"{who} has the mount {calibration.mount!r}, expected {' or '.join(mounts)}",
    )
    focal, centre = intrinsics[[0, 1], [0, 1]], intrinsics[:2, 2]
    size = np.array([camera.width, camera.height])
    require(
        bool((focal > 0).all()) and intrinsics[2, 2] == 1, f"{who} has no focal length in pixels"
    )
    require(
        bool(((centre > 0) & (centre < size)).all()),
        f"{who} has its centre {centre} outside of the image",
    )
    rotation = pose[:3, :3]
    upright = (
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0
    )
    require(
        bool(upright) and np.allclose(pose[3], [0, 0, 0, 1]),
        f"{who} has a T_mount_camera that is not a pose",
    )
    away_m = float(np.linalg.norm(pose[:3, 3]))
    require(away_m <= FARTHEST_CAMERA_M, f"{who} is {away_m:g} m away; are those millimetres?")


def _check_gripper(case: RobotCase) -> None:
    gripper = case.profile().gripper
    if gripper is None:
        raise NotApplicable("the robot has no gripper")
    require(
        gripper.closed_position != gripper.open_position, "the gripper is as far open as closed"
    )


def _check_workspace(case: RobotCase) -> None:
    workspace = case.profile().workspace
    if workspace is None:
        raise NotApplicable("the robot has no workspace")
    require(bool((workspace.lower_m < workspace.upper_m).all()), "the workspace is empty")


def _check_endpoints(case: RobotCase) -> None:
    endpoints = case.profile().endpoints
    if not endpoints:
        raise NotApplicable("the robot exposes no endpoints")
    names = [(e.kind, e.name) for e in endpoints]
    require(len(set(names)) == len(names), "two endpoints of one kind have the same name")
    for endpoint in endpoints:
        who = f"endpoint {endpoint.name!r}"
        require(bool(_ENDPOINT_NAME.fullmatch(endpoint.name)), f"{who} is not named in snake_case")
        require(
            endpoint.kind in ENDPOINT_KINDS,
            f"{who} has kind {endpoint.kind!r}, expected {', '.join(ENDPOINT_KINDS)}",
        )
        parts = endpoint.type.split("/")
        expected = f"package/{_INTERFACE[endpoint.kind]}/Name"
        ok = len(parts) == 3 and all(parts) and parts[1] == _INTERFACE[endpoint.kind]
        require(ok, f"{who} has type {endpoint.type!r}, expected {expected}")
        require(bool(endpoint.summary.strip()), f"{who} has no summary")
        require(endpoint.rate_hz >= 0, f"{who} has a rate of {endpoint.rate_hz} Hz")
        empty = [path for path, (low, high) in endpoint.bounds.items() if not low <= high]
        require(not empty, f"{who} has empty bounds for {', '.join(empty)}")


_SOURCE = "roboneuron.contract.profile.RobotProfile"

RULES: tuple[Rule[RobotCase], ...] = (
    Rule(
        id="robot/profile-named",
        text="`target` returns a RobotProfile of the descriptor's name.",
        source="roboneuron.plugins.specs.RobotSpec",
        check=_check_name,
    ),
    Rule(
        id="robot/limits-sane",
        text="An arm has finite limits for each joint: lower below upper, the others positive.",
        source="roboneuron.contract.profile.JointLimits",
        check=_check_limits,
    ),
    Rule(
        id="robot/home-inside",
        text="The home posture is within the limits.",
        source=_SOURCE,
        check=_check_home,
    ),
    Rule(
        id="robot/urdf-complete",
        text="The URDF holds base and TCP; what moves between them are the arm joints, in that "
        "order.",
        source=_SOURCE,
        check=_check_urdf,
    ),
    Rule(
        id="robot/limits-of-urdf",
        text="The profile's limits of joints and gripper are within the URDF's.",
        source="roboneuron.contract.profile.JointLimits",
        check=_check_urdf_limits,
    ),
    Rule(
        id="robot/home-in-workspace",
        text="At home the TCP is inside the workspace.",
        source="roboneuron.contract.profile.Workspace",
        check=_check_home_pose,
    ),
    Rule(
        id="robot/profile-stable",
        text="Every call of `target` returns the same.",
        source=_SOURCE,
        check=_check_stable,
    ),
    Rule(
        id="robot/kind-agrees",
        text="A base has no arm; an arm says which action widths it can execute.",
        source="roboneuron.plugins.specs.RobotSpec",
        check=_check_base,
    ),
    Rule(
        id="robot/cameras-agree",
        text="Descriptor and profile name the same cameras and roles; what is calibrated is a "
        "camera.",
        source="roboneuron.plugins.specs.CameraSpec",
        check=_check_cameras,
    ),
    Rule(
        id="robot/gripper-travels",
        text="The gripper's open and closed positions differ.",
        source="roboneuron.contract.profile.GripperProfile",
        check=_check_gripper,
    ),
    Rule(
        id="robot/workspace-not-empty",
        text="The workspace's lower corner is below its upper one.",
        source="roboneuron.contract.profile.Workspace",
        check=_check_workspace,
    ),
    Rule(
        id="robot/endpoints-usable",
        text="Endpoints have snake_case names, a known kind, an interface type of that kind, and "
        "bounds in order.",
        source="roboneuron.contract.profile.Endpoint",
        check=_check_endpoints,
    ),
)
"""Rules of robot profiles."""
