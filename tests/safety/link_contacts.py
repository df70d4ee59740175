"""Distances of the simulated FR3's links, by PyBullet, which shares nothing with the controller."""

from __future__ import annotations

import pybullet

from rn_robot_fr3.simulation import ArmSimulation

RIGID = [{"fr3_link7", "fr3_hand"}, {"fr3_leftfinger", "fr3_rightfinger"}]
"""Links that always overlap, and fingers that close on each other."""


def penetrations(simulation: ArmSimulation, least_m: float = 0.0) -> list[tuple[str, str, float]]:
    """Links that share no joint, or a moving link and the table, that are closer than `least_m`:
    names and distance [m], negative for an overlap.
    """
    client, robot, table = simulation.world.client, simulation.world.robot, 0
    infos = [
        pybullet.getJointInfo(robot, i, physicsClientId=client)
        for i in range(pybullet.getNumJoints(robot, physicsClientId=client))
    ]
    names = {-1: "fr3_link0"} | {info[0]: info[12].decode() for info in infos}
    parents = {info[0]: info[16] for info in infos}
    found = []
    for point in pybullet.getClosestPoints(robot, robot, least_m, physicsClientId=client):
        a, b = point[3], point[4]
        is_one = (
            a == b or parents.get(a) == b or parents.get(b) == a or {names[a], names[b]} in RIGID
        )
        if not is_one and point[8] < least_m:
            found.append((names[a], names[b], point[8]))
    for point in pybullet.getClosestPoints(robot, table, least_m, physicsClientId=client):
        if point[3] != -1 and point[8] < least_m:
            found.append((names[point[3]], "table", point[8]))
    return found
