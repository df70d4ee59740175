"""What a simulated FR3 touches, by the simulator's truth in its messages to the cameras."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack

import pybullet

from rn_robot_fr3.pybullet_world import PybulletArmWorld
from rn_robot_fr3.simulation import ArmSimulation
from rn_simulation.scene_state import SceneState

TOUCHING_M = 0.0005
"""Largest distance of two shapes that count as touching."""


def touched(scenes: Iterable[SceneState]) -> set[str]:
    """Names of the cubes, and "table", that the arm touches in any of these scenes of one cell."""
    found: set[str] = set()
    with ExitStack() as stack:
        simulation: ArmSimulation | None = None
        standing: set[tuple[int, str]] = set()
        for scene in scenes:
            if simulation is None:
                colours = [name for name, _ in scene.cubes]
                simulation = ArmSimulation(scene.seed, colours=colours, engine="pybullet")
                stack.enter_context(simulation)
                # the base always stands on the table
                standing = _touching(simulation)
            cubes = {
                name: (tuple(pose[:3]), tuple(pose[3:]))
                for (name, _), pose in zip(scene.cubes, scene.cube_poses.tolist(), strict=True)
            }
            simulation.place(scene.joints, cubes)
            found |= {name for _, name in _touching(simulation) - standing}
    return found


def _touching(simulation: ArmSimulation) -> set[tuple[int, str]]:
    """Each link of the arm that touches something, and what."""
    world = simulation.world
    assert isinstance(world, PybulletArmWorld)
    client, robot = world.client, world.robot
    names = {body: name for name, body in world.cube_bodies.items()}
    count = pybullet.getNumBodies(physicsClientId=client)
    others = {pybullet.getBodyUniqueId(i, physicsClientId=client) for i in range(count)} - {robot}
    return {
        (int(point[3]), names.get(body, "table"))
        for body in others
        for point in pybullet.getClosestPoints(robot, body, TOUCHING_M, physicsClientId=client)
    }
