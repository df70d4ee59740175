"""An arm as its URDF describes it: parts, limits, shapes and home, as a profile and as text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rn_standard.declared_arm.urdf_guesses import ArmParts, Chosen, guess
from rn_standard.declared_arm.urdf_home import FLOOR, SEEN_M, Home, find_home
from rn_standard.declared_arm.urdf_limits import LimitRow, read_limits
from rn_standard.declared_arm.urdf_meshes import GatheredShapes, gather_shapes
from rn_standard.declared_arm.urdf_tree import UrdfTree
from roboneuron import (
    CameraProfile,
    CollisionProfile,
    ConfigurationError,
    Endpoint,
    GripperProfile,
    JointLimits,
    RobotProfile,
)

_FCI_JOINTS = tuple(f"fr3_joint{i}" for i in range(1, 8))
_ENDPOINTS = (
    Endpoint(
        name="joint_trajectory",
        kind="publish",
        topic="joint_trajectory",
        type="trajectory_msgs/msg/JointTrajectory",
        summary="Move the joints of the arm [rad or m].",
        rate_hz=50.0,
        joint_limited=True,  # makes the tools move_joints and publish_joint_trajectory
    ),
    Endpoint(
        name="joint_states",
        kind="read",
        topic="joint_states",
        type="sensor_msgs/msg/JointState",
        summary="Measured joint positions [rad or m].",
    ),
    Endpoint(
        name="ee_pose",
        kind="read",
        topic="ee_pose",
        type="geometry_msgs/msg/PoseStamped",
        summary="Measured pose of the TCP in the base frame.",
    ),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmDraft:
    """All that a URDF says of an arm, and what was found for it.

    Attributes:
        source: the description.
        tree: its links and joints.
        parts: base, TCP, joints and gripper.
        limits, notes: of the joints, and what was made up.
        shapes: its meshes.
        home: where it starts.
        bare_profile: the profile without home, distances, cameras and endpoints.
    """

    source: Path
    tree: UrdfTree
    parts: ArmParts
    limits: list[LimitRow]
    notes: list[str]
    shapes: GatheredShapes
    home: Home
    bare_profile: RobotProfile

    def profile(self, cameras: Sequence[tuple[str, str]]) -> RobotProfile:
        """The whole profile. The floor is an obstacle of it unless the arm would touch it at home.

        Args:
            cameras: name and role of each; nominal images have 640 x 480 px.
        """
        collision = None
        if not self.home.unchecked:
            floor = (FLOOR,) if self.home.has_floor else ()
            collision = CollisionProfile(min_distance_m=self.home.min_distance_m, obstacles=floor)
        return replace(
            self.bare_profile,
            home_rad=self.home.position,
            collision=collision,
            cameras=tuple(
                CameraProfile(
                    name=name,
                    role=role,
                    frame_id=f"{name}_optical",
                    width=640,
                    height=480,
                )
                for name, role in cameras
            ),
            endpoints=_ENDPOINTS,
        )

    def guessed(self) -> list[str]:
        """One line for each guess, with its grounds."""
        parts, gripper = self.parts, self.parts.gripper
        fingers = "none"
        if gripper is not None:
            fingers = f"{gripper.joint}, {gripper.closed:g} closed .. {gripper.opened:g} open"
            if gripper.followers:
                fingers += f", with {', '.join(gripper.followers)}"
            if not gripper.is_measured:
                fingers += "; which end is open is not known, confirm it"
        lines = [
            f"base: {parts.base} ({parts.grounds['base']})",
            f"TCP: {parts.tcp} ({parts.grounds['tcp']}); its z axis must point out of the tool",
            f"joints: {', '.join(parts.joints)} ({parts.grounds['joints']})",
            f"gripper: {fingers} ({parts.grounds['gripper']})",
        ]
        if parts.left:
            lines.append(f"at rest, not driven: {', '.join(parts.left)}")
        return lines

    def report(self) -> list[str]:
        """All that a person should know and confirm, in lines."""
        shapes, home = self.shapes, self.home
        lines = [f"{self.source} says:"]
        lines += [f"  {line}" for line in self.guessed()]
        lines.append("It does not say, so that these are taken carefully:")
        lines += [f"  {note}" for note in self.notes]
        if shapes.missing:
            lines.append(
                f"Meshes without a file, left out: {', '.join(shapes.missing)}. Nothing shows "
                "them or keeps a distance from them; --package-path DIR says where to look."
            )
        if shapes.borrowed:
            lines.append(
                f"Without collision shapes, so that those for display count: "
                f"{', '.join(shapes.borrowed)}."
            )
        if shapes.bare:
            lines.append(f"Without any shape, NOT CHECKED for contact: {', '.join(shapes.bare)}.")
        if home.overlapping:
            pairs = ", ".join(f"{first} and {second}" for first, second in home.overlapping)
            lines.append(f"They touch in every posture, so that nothing compares them: {pairs}.")
        lines.append(self._home_line())
        return lines

    def _home_line(self) -> str:
        home = self.home
        posture = ", ".join(
            f"{joint} {value:g}"
            for joint, value in zip(self.parts.joints, home.position.tolist(), strict=True)
        )
        if home.unchecked:
            return f"Home: {posture}. Distances are NOT CHECKED: {home.unchecked}"
        floor = (
            "on a floor below its base" if home.has_floor else "with no floor, which it would hit"
        )
        if not home.nearest:
            return f"Home, {floor}: {posture}. All bodies are over {SEEN_M * 1000:g} mm apart."
        pair = home.nearest[0]
        return (
            f"Home, {floor}: {posture}. Nearest bodies: {pair.first} and {pair.second}, "
            f"{pair.distance_m * 1000:.0f} mm; it keeps {home.min_distance_m * 1000:g} mm."
        )


def draft_arm(
    name: str,
    path: Path,
    *,
    chosen: Chosen,
    package_paths: Sequence[Path] = (),
    driver: str = "",
    home: Sequence[float] = (),
) -> ArmDraft:
    """Read a description and find what is needed beyond it; writes nothing.

    Args:
        name: of the robot.
        path: of the URDF.
        chosen: what needs no guess.
        package_paths: see `gather_shapes`.
        driver: of the real arm, of which some move certain joints only.
        home: posture to start from, by joint [rad or m]; empty: it is searched for.

    Raises:
        ConfigurationError: the description is refused, or the arm touches itself or is outside its
            limits at `home`; says why, and which candidates there are.
    """
    try:
        urdf = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"The URDF {path} cannot be read: {error}") from error
    tree = UrdfTree(urdf)
    parts = guess(tree, chosen)
    if driver == "fci" and parts.joints != _FCI_JOINTS:
        raise ConfigurationError(
            f"The driver fci moves {_FCI_JOINTS[0]} .. {_FCI_JOINTS[-1]} of a Franka Research 3, "
            f"not {', '.join(parts.joints)}.",
            hint="Choose the driver ros2-control.",
        )
    limits, notes = read_limits(tree, parts.joints)
    shapes = gather_shapes(path, urdf, package_paths)
    profile = RobotProfile(
        name=name,
        urdf=shapes.with_files(),
        base_link=parts.base,
        tcp_link=parts.tcp,
        arm_joints=parts.joints,
        limits=JointLimits(
            lower=np.array([row.lower for row in limits]),
            upper=np.array([row.upper for row in limits]),
            velocity=np.array([row.velocity for row in limits]),
            acceleration=np.array([row.acceleration for row in limits]),
            effort=np.array([row.effort for row in limits]),
        ),
        gripper=None
        if parts.gripper is None
        else GripperProfile(
            joint=parts.gripper.joint,
            closed_position=parts.gripper.closed,
            open_position=parts.gripper.opened,
        ),
    )
    return ArmDraft(
        source=path,
        tree=tree,
        parts=parts,
        limits=limits,
        notes=notes,
        shapes=shapes,
        home=find_home(profile, home),
        bare_profile=profile,
    )
