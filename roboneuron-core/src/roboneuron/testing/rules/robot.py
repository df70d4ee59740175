"""Rules of robot profiles: limits, names, cameras and endpoints that agree with each other and with the descriptor."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import numpy as np

from roboneuron.contract import RobotProfile
from roboneuron.testing.cases import RobotCase
from roboneuron.testing.rule import NotApplicable, Rule, Violation, require

ENDPOINT_KINDS = ("publish", "read", "service", "action")
"""Values of `Endpoint.kind`."""
_ENDPOINT_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_INTERFACE = {"publish": "msg", "read": "msg", "service": "srv", "action": "action"}


def _check_name(case: RobotCase) -> None:
    name = case.profile().name
    require(name == case.spec.name, f"the profile is named {name!r}, the descriptor {case.spec.name!r}")


def _arm(case: RobotCase) -> RobotProfile:
    if case.spec.robot_kind != "arm":
        raise NotApplicable(f"the robot is of kind {case.spec.robot_kind!r}")
    return case.profile()


def _check_limits(case: RobotCase) -> None:
    profile = _arm(case)
    limits, count = profile.limits, len(profile.arm_joints)
    require(count > 0, "an arm has no arm_joints")
    if limits is None:
        raise Violation("an arm has no limits")
    for name in ("lower", "upper", "velocity", "acceleration", "effort"):
        values = getattr(limits, name)
        require(values.shape == (count,), f"limits.{name} has shape {values.shape}, expected ({count},)")
        require(bool(np.isfinite(values).all()), f"limits.{name} holds a value that is not finite")
    require(bool((limits.lower < limits.upper).all()), "a lower limit is not below its upper limit")
    for name in ("velocity", "acceleration", "effort"):
        require(bool((getattr(limits, name) > 0).all()), f"limits.{name} holds a value that is not positive")


def _check_home(case: RobotCase) -> None:
    profile = _arm(case)
    home, limits = profile.home_rad, profile.limits
    if home is None or limits is None:
        raise Violation("an arm has no home posture or no limits")
    require(home.shape == limits.lower.shape, f"home_rad has shape {home.shape}, expected {limits.lower.shape}")
    inside = (limits.lower <= home) & (home <= limits.upper)
    outside = [n for n, ok in zip(profile.arm_joints, inside.tolist(), strict=True) if not ok]
    require(not outside, f"home is outside the limits of {', '.join(outside)}")


def _check_urdf(case: RobotCase) -> None:
    profile = _arm(case)
    require(bool(profile.urdf), "an arm has no URDF")
    try:
        root = ElementTree.fromstring(profile.urdf)
    except ElementTree.ParseError as error:
        raise Violation(f"the URDF is no XML: {error}") from error
    links = {link.get("name") for link in root.iter("link")}
    parents = {joint.find("child").get("link"): joint for joint in root.findall("joint")}  # type: ignore[union-attr]
    absent = [link for link in (profile.base_link, profile.tcp_link) if link not in links]
    require(not absent, f"the URDF has no link {', '.join(absent)}")
    chain: set[str | None] = set()
    link: str | None = profile.tcp_link
    while link != profile.base_link and link in parents:
        joint = parents[link]
        chain.add(joint.get("name"))
        link = joint.find("parent").get("link")  # type: ignore[union-attr]
    require(link == profile.base_link, f"{profile.tcp_link} is not carried by {profile.base_link} in the URDF")
    astray = [n for n in profile.arm_joints if n not in chain]
    require(not astray, f"joints that are not between base and TCP in the URDF: {', '.join(astray)}")


def _check_cameras(case: RobotCase) -> None:
    profile = case.profile()
    declared = {(c.name, c.role) for c in case.spec.cameras}
    actual = {(c.name, c.role) for c in profile.cameras}
    require(declared == actual, f"the descriptor declares the cameras {sorted(declared)}, the profile {sorted(actual)}")
    for camera in profile.cameras:
        require(bool(camera.frame_id), f"camera {camera.name!r} has no frame_id")
        require(camera.width > 0 and camera.height > 0, f"camera {camera.name!r} is {camera.width}x{camera.height}")


def _check_gripper(case: RobotCase) -> None:
    gripper = case.profile().gripper
    if gripper is None:
        raise NotApplicable("the robot has no gripper")
    require(gripper.closed_position != gripper.open_position, "the gripper is as far open as closed")


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
            endpoint.kind in ENDPOINT_KINDS, f"{who} has kind {endpoint.kind!r}, expected {', '.join(ENDPOINT_KINDS)}"
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
        text="An arm has finite limits for each joint, lower below upper, the others positive.",
        source="roboneuron.contract.profile.JointLimits",
        check=_check_limits,
    ),
    Rule(id="robot/home-inside", text="The home posture is within the limits.", source=_SOURCE, check=_check_home),
    Rule(
        id="robot/urdf-complete",
        text="The URDF holds base and TCP, with every arm joint between them.",
        source=_SOURCE,
        check=_check_urdf,
    ),
    Rule(
        id="robot/cameras-agree",
        text="Descriptor and profile name the same cameras and roles.",
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
        text="Endpoints have snake_case names, a known kind, an interface type of that kind, and bounds in order.",
        source="roboneuron.contract.profile.Endpoint",
        check=_check_endpoints,
    ),
)
"""Rules of robot profiles."""
