"""A robot package from a URDF: the words that fill the templates."""

from __future__ import annotations

import json

import numpy as np

from rn_standard.declared_arm.arm_draft import ArmDraft
from rn_standard.declared_arm.real_drivers import REAL_DRIVERS, RealDriver
from rn_standard.declared_arm.urdf_guesses import ArmParts
from rn_standard.declared_arm.urdf_home import FEWEST_FOR_POSE, FLOOR, Home
from rn_standard.declared_arm.urdf_joints import MOVABLE
from rn_standard.declared_arm.urdf_limits import LimitRow
from rn_standard.declared_arm.urdf_tree import UrdfTree
from roboneuron import F64, DriverSpec


def words_of(draft: ArmDraft, name: str, driver_name: str | None) -> dict[str, str]:
    """Words of the templates of `arm`.

    Args:
        draft: the arm.
        name: of the robot.
        driver_name: a key of `REAL_DRIVERS`; None for the simulation only.
    """
    parts, driver = draft.parts, REAL_DRIVERS.get(driver_name or "")
    values = [value for row in draft.limits for value in (row.lower, row.upper)]
    first, goal = parts.joints[0], float(draft.home.position[0])
    goal += 0.05 if goal + 0.05 <= draft.limits[0].upper else -0.05
    short = len(parts.joints) < FEWEST_FOR_POSE
    tables = ['\n[plugins.urdf]\ntrack = "position"  # few joints: rotations follow'] * short
    if driver is not None:
        told = "\n# ".join([f"[plugins.{name}]", *driver.options.splitlines()])
        tables.append(f'\n# With driver = "{driver_name}":\n# {told}')
    return {
        "base": parts.base,
        "tcp": parts.tcp,
        "summary": f"{draft.source.stem}, an arm of {len(parts.joints)} joints.",
        "inf": "from math import inf\n" if not np.isfinite(values).all() else "",
        "gripper_import": "    GripperProfile,\n" if parts.gripper else "",
        "gripper": _gripper_line(parts),
        "collision": f"CollisionProfile(min_distance_m={draft.home.min_distance_m:g})"
        if not draft.home.unchecked
        else "None",
        "limits": "\n".join(_limits_line(row) for row in draft.limits),
        "home": "\n".join(
            f'    "{joint}": {float(value):g},'
            for joint, value in zip(parts.joints, draft.home.position, strict=True)
        ),
        "notes": "\n".join(f"- {note}" for note in draft.notes),
        "requirement": "Requirement, " if driver else "",
        "driver": "" if driver is None else _driver_lines(driver.spec),
        "real_driver": f'  # "{driver_name}" moves the arm' if driver else "",
        "real": _real_steps(name, driver_name, driver),
        "floor": _floor_lines(draft.home),
        "options": "".join(f"{table}\n" for table in tables),
        "guessed": "\n".join(f"- {line}" for line in draft.guessed()),
        "first": first,
        "first_goal": f"{goal:g}",
        "joints": "\n".join(_joint_rows(draft)),
    }


def _joint_rows(draft: ArmDraft) -> list[str]:
    home = dict(zip(draft.parts.joints, draft.home.position.tolist(), strict=True))
    axes = _axes(draft.tree, draft.parts, home)
    verbs = {True: "slides along", False: "turns about"}
    return [
        f"| {joint} | {home[joint]:g} | {verbs[joint in draft.tree.kinds.prismatic]} "
        f"({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f}) | | |"
        for joint, axis in axes.items()
    ]


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


def _driver_lines(driver: DriverSpec) -> str:
    [needed] = driver.requires
    recovers = "            recovers=True,\n" if driver.recovers else ""
    return (
        "        DriverSpec(\n"
        f'            name="{driver.name}",\n'
        f'            summary="{driver.summary}",\n'
        f'            target="{driver.target}",\n'
        f'            config="{driver.config}",\n'
        "            requires=(\n"
        "                Requirement(\n"
        f'                    module="{needed.module}",\n'
        f"                    install={json.dumps(needed.install)},\n"
        "                ),\n"
        "            ),\n"
        f"{recovers}"
        "        ),\n"
    )


def _real_steps(name: str, driver_name: str | None, driver: RealDriver | None) -> str:
    if driver is None:
        return (
            "No driver was named. `roboneuron plugins new robot ... --driver ros2-control` names\n"
            "one that exists; for a library of the manufacturer write a class with the five\n"
            "methods of `roboneuron.RobotDriver`, as `roboneuron plugins new robot NAME` without\n"
            "a URDF shows."
        )
    [needed] = driver.spec.requires
    steps = driver.steps.replace("NAME", name)
    return f'`{needed.install}`, and `driver = "{driver_name}"` under `[robot]`.\n{steps}'


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
