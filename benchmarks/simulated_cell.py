"""A task's cell on simulated time, and a gripper that fails."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import numpy as np

from rn_eval.cubes import CubesScene
from rn_eval.suite import Setup
from rn_robot_fr3.limits import FINGER_JOINT
from rn_robot_fr3.simulation import STEP_S, ArmSimulation
from rn_standard.tasks.predicates import Predicate, parse_predicate
from rn_standard.tasks.snapshot import Snapshot, StillClock
from rn_standard.tasks.task_robot import PolicyState
from roboneuron import Backend, Observation, RoboNeuronError
from roboneuron.server.tool import Picture

CAMERA_S = 0.1
"""Period of images and of the servo's actions [s]."""
STILL_RAD_S = 0.01
CLOSED_M, JAMMED_M = 0.01, 0.031
LETS_GO_M = (0.03, 0.17)


class FailingGripper:
    """Changes the driver's gripper commands on their way to the simulation, to fail some grasps."""

    def __init__(self, simulation: ArmSimulation, share: float, seed: int) -> None:
        self._simulation = simulation
        self._set_target = simulation.set_target
        self._random = random.Random(seed)
        self._share = share
        self._fault = ""
        self._open = True
        self._let_go_m = 0.0
        self.grasps = self.failed = 0
        simulation.set_target = self.command  # type: ignore[method-assign]

    def command(self, names: Any, position: Any, duration_s: float) -> Any:
        """As `ArmSimulation.set_target`, with the current fault applied."""
        wanted = np.array(position, dtype=float)
        if FINGER_JOINT in names:
            finger = list(names).index(FINGER_JOINT)
            self._note(float(wanted[finger]))
            if self._fault == "jams":
                wanted[finger] = max(wanted[finger], JAMMED_M)
            if (
                self._fault == "lets go"
                and self._simulation.tcp_pose().position_m[2] > self._let_go_m
            ):
                wanted[finger] = 0.04
                if (self._simulation.gripper_open() or 0.0) > 0.9:
                    self._fault = "has let go"
        return self._set_target(names, wanted, duration_s)

    def _note(self, target: float) -> None:
        """Draw at random, when a grasp begins, whether and how it fails."""
        if target > CLOSED_M:
            self._open = True
            if self._fault != "lets go":
                self._fault = ""
        elif self._open:
            self._open = False
            self.grasps += 1
            self._fault = ""
            if self._random.random() < self._share:
                self.failed += 1
                self._fault = self._random.choice(["jams", "lets go"])
                self._let_go_m = self._simulation.tcp_pose().position_m[2] + self._random.uniform(
                    *LETS_GO_M
                )


class SimulatedCell:
    """Implements `rn_standard.tasks.task_robot.TaskRobot` on the time of a stepped simulation."""

    def __init__(self, scene: CubesScene, backend: Backend, setup: Setup) -> None:
        self._scene, self._backend, self._setup = scene, backend, setup
        self.simulation: ArmSimulation = scene._simulation
        self._tick = 0
        self._observation: Observation = scene.observe(1)
        self._instruction = ""
        self._failure, self._done, self._acted = "", False, False
        self._still = StillClock()
        self.moved_s = 0.0
        """Last simulated time at which a joint of the arm moved [s]."""

    def now_s(self) -> float:
        return self._tick * STEP_S

    def wait(self, seconds: float) -> bool:
        for _ in range(round(seconds / STEP_S)):
            if self._tick % round(CAMERA_S / STEP_S) == 0:
                self._act()
            self._scene.advance(1)
            self._tick += 1
            velocity = self.simulation.joint_states()[1]
            if np.abs(velocity[:7]).max() > STILL_RAD_S:
                self.moved_s = self.now_s()
        return False

    def _act(self) -> None:
        """Run one camera period: new images, and an action for them."""
        self._scene.watch(self.now_s())
        self._observation = replace(
            self._scene.observe(round(self.now_s() * 1e9) + 1), instruction=""
        )
        if not self._instruction:
            return
        try:
            chunk = self._backend.predict(replace(self._observation, instruction=self._instruction))
        except RoboNeuronError as error:
            self._failure = str(error)
            return
        self._failure, self._done, self._acted = "", chunk.metrics["done"] >= 0.5, True
        self._scene.act(chunk.actions[0], self.now_s())

    def begin(self, instruction: str) -> None:
        self._backend.reset()
        self._instruction = instruction
        self._failure, self._done, self._acted = "", False, False

    def policy(self) -> PolicyState:
        return PolicyState(has_acted=self._acted, failure=self._failure)

    def look(self) -> Snapshot:
        position, _ = self.simulation.joint_states()
        joints = dict(zip(map(str, range(9)), position.tolist(), strict=True))
        return Snapshot(
            now_s=self.now_s(),
            joints=joints,
            tcp=self._observation.ee_pose
            if self._observation.ee_pose is None
            else self.simulation.tcp_pose(),
            gripper_open=self.simulation.gripper_open(),
            still_s=self._still.observe(self.now_s(), joints),
            policy_done=self._done if self._acted else None,
            frames=self._observation.frames,
        )

    def end(self) -> None:
        self._instruction = ""

    def evidence(self, when: str) -> tuple[Picture, ...]:
        return ()


def lifted(colour: str) -> Predicate:
    """Whether the cube of this colour has been lifted and held for a second."""
    return parse_predicate(
        {
            "kind": "held",
            "for_s": 1.0,
            "of": {
                "kind": "all",
                "of": [
                    {"kind": "gripper_holds", "least_open": 0.15, "most_open": 0.9},
                    {
                        "kind": "monitor",
                        "name": "colour-lifted",
                        "options": {"colour": colour, "height_m": 0.12},
                    },
                ],
            },
        }
    )


def on_the_way_up() -> Predicate:
    """Whether the gripper holds something and is in the middle of the lift."""
    box = {"kind": "tcp_in", "lower_m": [0, -1, 0.10], "upper_m": [1, 1, 1]}
    return parse_predicate(
        {"kind": "all", "of": [{"kind": "gripper_holds", "most_open": 0.8}, box]}
    )
