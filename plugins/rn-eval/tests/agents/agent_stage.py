"""Hand-made ground truth: a witness's samples, interpolated from a few key frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rn_eval.agents.conduct import Conduct, ToolCall
from rn_eval.agents.tasks.pick import HOME_M
from rn_eval.agents.tasks.scenes import cubes_of
from rn_eval.agents.truth import Truth

RATE_HZ = 30
ARM_M = 0.1
"""The box around the arm reaches so far around the TCP."""
HOME_RAD = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4)


@dataclass
class Stage:
    """Moves an arm and the cubes of a scene; each step is a straight line, then a standstill."""

    scene: object
    tcp: tuple = HOME_M
    joint7: float = math.pi / 4
    finger: float = 0.04
    t: list = field(default_factory=list)
    rows: list = field(default_factory=list)
    latched: list = field(default_factory=list)

    def __post_init__(self):
        self.cubes = {
            name: np.array([cube.x_m, cube.y_m, cube.edge_m / 2])
            for name, cube in cubes_of(self.scene).items()
        }
        self.edges = {name: cube.edge_m for name, cube in cubes_of(self.scene).items()}
        self.yaws = {name: cube.yaw_rad for name, cube in cubes_of(self.scene).items()}
        self.stand(0.5)

    def _add(self, tcp, joint7):
        self.t.append((self.t[-1] if self.t else 0.0) + 1 / RATE_HZ)
        cubes = np.array([self.cubes[name] for name in self.cubes])
        yaws = np.array([self.yaws[name] for name in self.cubes])
        self.rows.append((np.array(tcp), joint7, self.finger, cubes, yaws))

    def stand(self, seconds=1.0):
        for _ in range(round(seconds * RATE_HZ)):
            self._add(self.tcp, self.joint7)
        return self

    def go(self, tcp=None, joint7=None, seconds=2.0, carry=None):
        """Move the TCP or the last joint, with a cube in the hand."""
        goal = self.tcp if tcp is None else tuple(tcp)
        turn = self.joint7 if joint7 is None else joint7
        start, begun = np.array(self.tcp), self.joint7
        for step in range(1, round(seconds * RATE_HZ) + 1):
            share = step / round(seconds * RATE_HZ)
            place = start + (np.array(goal) - start) * share
            if carry is not None:
                self.cubes[carry] = place.copy()
            self._add(place, begun + (turn - begun) * share)
        self.tcp, self.joint7 = goal, turn
        return self

    def by(self, dx=0.0, dy=0.0, dz=0.0, seconds=2.0, carry=None):
        x, y, z = self.tcp
        return self.go((x + dx, y + dy, z + dz), seconds=seconds, carry=carry)

    def lift(self, colour):
        x, y, z = self.cubes[colour]
        self.go((x, y, z))
        self.finger = 0.02
        return self.by(dz=0.2, carry=colour).stand()

    def slide(self, colour, dx, dy, rise=0.0):
        """Push a cube over the table, or carry it so low."""
        self.cubes[colour] = self.cubes[colour] + np.array([dx, dy, rise])
        self.stand(0.2)
        self.cubes[colour] = self.cubes[colour] - np.array([0.0, 0.0, rise])
        return self.stand()

    def put(self, colour, x, y, z=None, seconds=4.0):
        """Lower the held cube onto the table, or to a height, and release it."""
        height = self.edges[colour] / 2 if z is None else z
        self.go((x, y, self.tcp[2]), carry=colour)
        self.go((x, y, height), carry=colour, seconds=seconds)
        self.finger = 0.04
        return self.by(dz=0.1).stand()

    def latch(self, from_s=0.0, to_s=None):
        self.latched.append((from_s, self.t[-1] if to_s is None else to_s))
        return self

    def truth(self):
        joints = np.tile(np.array(HOME_RAD), (len(self.t), 1))
        joints[:, 6] = [row[1] for row in self.rows]
        tcp = np.array([row[0] for row in self.rows])
        joints[:, 0] = np.linalg.norm(tcp - tcp[0], axis=1)
        return Truth(
            t_s=np.array(self.t),
            joints_rad=joints,
            finger_m=np.array([row[2] for row in self.rows]),
            tcp_m=tcp,
            names=tuple(self.cubes),
            cubes_m=np.array([row[3] for row in self.rows]),
            edges_m=np.array([self.edges[name] for name in self.cubes]),
            yaws_rad=np.array([row[4] for row in self.rows]),
            arm_m=tcp[:, None, :] + np.array([[-ARM_M] * 3, [ARM_M] * 3]),
            latched_s=tuple(self.latched),
        )


def said(claim="done", answer="", calls=(), files=(), wall_s=None):
    """Last words in the required form, and calls without errors."""
    words = (f"ANSWER: {answer}\n" if answer else "") + f"CLAIM: {claim}"
    return Conduct(
        words=words,
        calls=tuple(ToolCall(at_s=1.0, tool=name, took_s=0.1) for name in calls),
        files=files,
        wall_s=100.0 if wall_s is None else wall_s,
    )
