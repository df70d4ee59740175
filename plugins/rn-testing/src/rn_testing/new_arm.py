"""A robot package from a URDF: what it says of the arm, and the words that fill the templates."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rn_testing.kinematics import MOVABLE
from rn_testing.urdf_guesses import ArmParts, Chosen, guess
from rn_testing.urdf_home import FEWEST_FOR_POSE, FLOOR, SEEN_M, Home, find_home
from rn_testing.urdf_limits import LimitRow, read_limits
from rn_testing.urdf_meshes import GatheredShapes, gather_shapes
from rn_testing.urdf_tree import UrdfTree
from roboneuron import (
    F64,
    ConfigurationError,
    GripperProfile,
    JointLimits,
    RobotProfile,
)

FCI_JOINTS = tuple(f"fr3_joint{i}" for i in range(1, 8))


@dataclass(frozen=True, kw_only=True, slots=True)
class RealDriver:
    """A driver of real arms that a package can name.

    Attributes:
        summary, target, config: as in its descriptor.
        module: what must be importable.
        install: the command for that.
        options: lines for roboneuron.toml, with `NAME` for the robot's.
        steps: what to do before the first motion.
    """

    summary: str
    target: str
    config: str
    module: str
    install: str
    options: str
    steps: str


DRIVERS = {
    "ros2-control": RealDriver(
        summary="joint_trajectory_controller of ros2_control",
        target="rn_driver_ros2control.driver:Ros2ControlDriver",
        config="rn_driver_ros2control.options:Ros2ControlOptions",
        module="rn_driver_ros2control",
        install="pip install ./plugins/rn-driver-ros2control",
        options='controller = "/joint_trajectory_controller"\njoint_states = "/joint_states"',
        steps="The command is for RoboNeuron's source folder. `ros2 control list_controllers`\n"
        "names the active controller of these joints: write it under `[plugins.NAME]`. If it runs\n"
        "on another machine, set `ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET`.",
    ),
    "lerobot": RealDriver(
        summary="The arm by lerobot's own driver, in lerobot's environment",
        target="rn_robot_lerobot.lerobot_driver:LerobotDriver",
        config="rn_robot_lerobot.lerobot_options:LerobotDriverOptions",
        module="lerobot",
        install='pip install "lerobot[feetech,dynamixel]>=0.6.1,<0.7" (Python 3.12)',
        options='type = "so101_follower"\nid = "my_arm"\nport = "/dev/ttyACM0"',
        steps="Calibrate the arm by `lerobot-calibrate`, and write type, id and port under\n"
        "`[plugins.NAME]`. Motors are joints of the same name; others, units and directions:\n"
        "`[plugins.NAME.motors]`.",
    ),
    "fci": RealDriver(
        summary="A Franka Research 3 over its network protocol",
        target="rn_robot_fr3.fci.driver:FciDriver",
        config="rn_robot_fr3.fci.options:FciDriverOptions",
        module="pylibfranka",
        install="pip install pylibfranka ruckig franky-control (Python 3.11 or 3.12, x86-64)",
        options='host = "172.16.0.2"',
        steps="Write the arm's address under `[plugins.NAME]`; `roboneuron fr3` checks it.",
    ),
}
"""By the name of `--driver`."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmDraft:
    """All that the package of an arm holds.

    Attributes:
        source: the description.
        tree: its links and joints.
        parts: base, TCP, joints and gripper.
        limits, notes: of the joints, and what was made up.
        shapes: its meshes.
        home: where it starts.
        driver: of the real arm; None for the simulation only.
    """

    source: Path
    tree: UrdfTree
    parts: ArmParts
    limits: list[LimitRow]
    notes: list[str]
    shapes: GatheredShapes
    home: Home
    driver: str | None

    def words(self, name: str) -> dict[str, str]:
        """Words of the templates of `arm`, for a robot of that name."""
        parts, driver = self.parts, DRIVERS.get(self.driver or "")
        values = [value for row in self.limits for value in (row.lower, row.upper)]
        first, goal = parts.joints[0], float(self.home.position[0])
        goal += 0.05 if goal + 0.05 <= self.limits[0].upper else -0.05
        short = len(parts.joints) < FEWEST_FOR_POSE
        tables = ['\n[plugins.urdf]\ntrack = "position"  # few joints: rotations follow'] * short
        if driver is not None:
            told = "\n# ".join([f"[plugins.{name}]", *driver.options.splitlines()])
            tables.append(f'\n# With driver = "{self.driver}":\n# {told}')
        return {
            "base": parts.base,
            "tcp": parts.tcp,
            "summary": f"{self.source.stem}, an arm of {len(parts.joints)} joints.",
            "inf": "from math import inf\n" if not np.isfinite(values).all() else "",
            "gripper_import": "    GripperProfile,\n" if parts.gripper else "",
            "gripper": _gripper_line(parts),
            "collision": f"CollisionProfile(min_distance_m={self.home.min_distance_m:g})"
            if not self.home.unchecked
            else "None",
            "limits": "\n".join(_limits_line(row) for row in self.limits),
            "home": "\n".join(
                f'    "{joint}": {float(value):g},'
                for joint, value in zip(parts.joints, self.home.position, strict=True)
            ),
            "notes": "\n".join(f"- {note}" for note in self.notes),
            "requirement": "Requirement, " if driver else "",
            "driver": "" if driver is None else _driver_lines(self.driver or "", driver),
            "real_driver": f'  # "{self.driver}" moves the arm' if driver else "",
            "real": _real_steps(name, self.driver, driver),
            "floor": _floor_lines(self.home),
            "options": "".join(f"{table}\n" for table in tables),
            "guessed": "\n".join(f"- {line}" for line in self.guessed()),
            "first": first,
            "first_goal": f"{goal:g}",
            "joints": "\n".join(self._joint_rows()),
        }

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

    def _joint_rows(self) -> list[str]:
        home = dict(zip(self.parts.joints, self.home.position.tolist(), strict=True))
        axes = _axes(self.tree, self.parts, home)
        verbs = {True: "slides along", False: "turns about"}
        return [
            f"| {joint} | {home[joint]:g} | {verbs[joint in self.tree.kinds.prismatic]} "
            f"({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f}) | | |"
            for joint, axis in axes.items()
        ]


def draft_arm(
    name: str,
    path: Path,
    *,
    chosen: Chosen,
    package_paths: Sequence[Path] = (),
    driver: str | None = None,
) -> ArmDraft:
    """Read a description and find what its package needs; writes nothing.

    Args:
        name: of the robot.
        path: of the URDF.
        chosen: what needs no guess.
        package_paths: see `gather_shapes`.
        driver: a key of `DRIVERS`; None for the simulation only.

    Raises:
        ConfigurationError: the description is refused; says why, and which candidates there are.
    """
    try:
        urdf = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"--urdf: {path} cannot be read: {error}") from error
    tree = UrdfTree(urdf)
    parts = guess(tree, chosen)
    if driver == "fci" and parts.joints != FCI_JOINTS:
        raise ConfigurationError(
            f"--driver fci moves {FCI_JOINTS[0]} .. {FCI_JOINTS[-1]} of a Franka Research 3, not "
            f"{', '.join(parts.joints)}.",
            hint="Choose --driver ros2-control.",
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
        home=find_home(profile),
        driver=driver,
    )


def _limits_line(row: LimitRow) -> str:
    values = (row.lower, row.upper, row.velocity, row.acceleration, row.effort)
    told = ", ".join(repr(float(value)) for value in values)
    return f'    "{row.joint}": ({told}),'


def _gripper_line(parts: ArmParts) -> str:
    gripper = parts.gripper
    if gripper is None:
        return ""
    ends = f"closed_position={gripper.closed!r}, open_position={gripper.opened!r}"
    return f'        gripper=GripperProfile(joint="{gripper.joint}", {ends}),\n'


def _driver_lines(name: str, driver: RealDriver) -> str:
    return (
        "        DriverSpec(\n"
        f'            name="{name}",\n'
        f'            summary="{driver.summary}",\n'
        f'            target="{driver.target}",\n'
        f'            config="{driver.config}",\n'
        "            requires=(\n"
        "                Requirement(\n"
        f'                    module="{driver.module}",\n'
        f"                    install={json.dumps(driver.install)},\n"
        "                ),\n"
        "            ),\n"
        "        ),\n"
    )


def _real_steps(name: str, driver_name: str | None, driver: RealDriver | None) -> str:
    if driver is None:
        return (
            "No driver was named. `roboneuron new robot ... --driver ros2-control` names one that\n"
            "exists; for a library of the manufacturer write a class with the five methods of\n"
            "`roboneuron.RobotDriver`, as `roboneuron new robot NAME` without a URDF shows."
        )
    steps = driver.steps.replace("NAME", name)
    return f'`{driver.install}`, and `driver = "{driver_name}"` under `[robot]`.\n{steps}'


def _floor_lines(home: Home) -> str:
    if not home.has_floor:
        return "# No floor: the arm would touch one below its base. Describe what it stands on."
    lower, upper = FLOOR.lower_m.tolist(), FLOOR.upper_m.tolist()
    return (
        "# What it stands on, in the frame of its base. Correct it if the arm hangs, or higher.\n"
        f'[[limits.obstacles]]\nname = "{FLOOR.name}"\nlower_m = {lower}\nupper_m = {upper}'
    )


def _axes(tree: UrdfTree, parts: ArmParts, home: dict[str, float]) -> dict[str, F64]:
    """Axis of each joint of the arm in the base frame, float64 (3,), at home."""
    configuration = tree.kinds.configuration()
    placed = dict(zip(configuration.order, configuration.of(home).tolist(), strict=True))
    base = np.eye(4)
    for joint in tree.chain(parts.base):
        base = base @ joint.transform(placed.get(joint.name, 0.0))
    pose, found = np.eye(4), {}
    for joint in tree.chain(parts.tcp):
        if joint.kind in MOVABLE and joint.name in parts.joints:
            axis = base[:3, :3].T @ pose[:3, :3] @ joint.origin[:3, :3] @ joint.axis
            found[joint.name] = np.round(axis, 2) + 0.0  # no negative zero
        pose = pose @ joint.transform(placed.get(joint.name, 0.0))
    return found
