"""Demonstrations: the teacher, with deliberate disturbances, picks cubes in the simulated cell;
images and states are stored.

They are divided into shards. A shard depends only on its number, so any process can recreate it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_controller_urdf.controller import UrdfController
from rn_policy_cubes.replacing import replacing
from rn_policy_cubes.teacher import STEP_S, Situations, act, tilt_of, yaw_of
from rn_robot_fr3.profile import profile
from rn_robot_fr3.scene import REGION_X_M, REGION_Y_M, SPACING_M
from rn_robot_fr3.simulation import JOINTS, ArmSimulation
from rn_simulation.cubes import DEFAULT_COLOURS
from roboneuron import Action, Hold, JointSample, matrix_from_quaternion

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

COLOURS = DEFAULT_COLOURS
VIEWS = 256
"""Number of images of one shard."""
FIRST_SEED = 1_000_000
"""First seed of demonstration scenes; lower seeds are for evaluation."""
SEEDS_PER_SHARD = 1000
SIDE_PX = 224
ROW = np.dtype(
    [
        ("tcp_m", "f4", (3,)),
        ("rotation", "f4", (3, 3)),
        ("opening", "f4"),
        ("target", "i4"),
        ("seed", "i4"),
        ("cube_m", "f4", (len(COLOURS), 3)),
        ("cube_yaw_rad", "f4", (len(COLOURS),)),
        ("edge_m", "f4", (len(COLOURS),)),
    ]
)
"""State belonging to one image."""

_TICKS = round(STEP_S * 240)
_MOST_STEPS = 110
_LONGEST_M = 0.045


def situations(rows: NDArray[np.void], cube: int) -> Situations:
    """Input of the teacher for the views of `rows` (n,), if cube number `cube` is named."""
    rotation = rows["rotation"].astype(np.float64)
    return Situations(
        tcp_m=rows["tcp_m"].astype(np.float64),
        yaw_rad=np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]),
        tilt_rad=tilt_of(rotation),
        opening=rows["opening"].astype(np.float64),
        cube_m=rows["cube_m"][:, cube].astype(np.float64),
        cube_yaw_rad=rows["cube_yaw_rad"][:, cube].astype(np.float64),
        edge_m=rows["edge_m"][:, cube].astype(np.float64),
    )


def write_shard(
    directory: Path, number: int, views: int = VIEWS, tell: Callable[[int], object] | None = None
) -> tuple[int, int]:
    """Create shard `number`; returns the number of its episodes that lifted the cube, and of all
    its episodes.

    `tell` is called with the number of its views after each episode.
    """
    return fill_shard(directory, ShardRecorder(number, views), tell)


def fill_shard(
    directory: Path, recorder: ShardRecorder, tell: Callable[[int], object] | None = None
) -> tuple[int, int]:
    """Let a recorder fill its shard, and write it; as `write_shard`."""
    rows_file, pictures_file = shard_files(directory, recorder.number)
    directory.mkdir(parents=True, exist_ok=True)
    recorder.run(tell or (lambda made: None))
    # the rows last: a shard exists once they do
    for path, array in ((pictures_file, recorder.pictures), (rows_file, recorder.rows)):
        with replacing(path) as unfinished, unfinished.open("wb") as file:
            np.save(file, array)
    return recorder.lifted, len(set(recorder.rows["seed"]))


def shard_files(directory: Path, number: int) -> tuple[Path, Path]:
    """Paths of a shard's rows and images."""
    return directory / f"rows-{number:05d}.npy", directory / f"pictures-{number:05d}.npy"


@dataclass
class _Disturbance:
    """Disturbance of the teacher's actions in one episode."""

    random: np.random.Generator
    noise_m: float
    kick: F64 = field(default_factory=lambda: np.zeros(3))
    kicked: int = 0
    snapped: int = 0

    def apply(self, action: F64, now: Situations) -> F64:
        """The disturbed action."""
        random, action = self.random, action.copy()
        if self.kicked == 0 and self.noise_m > 0 and random.random() < 0.04:
            self.kick, self.kicked = random.normal(0, 0.018, 3), int(random.integers(2, 5))
        if self.kicked > 0 and now.opening[0] > 0.9:
            action[:3] = self.kick
            action[5] += random.normal(0, 0.1)
            self.kicked -= 1
        action[:3] += random.normal(0, self.noise_m, 3) * (
            1.0 if now.distance_m[0] > 0.03 else 0.35
        )
        action[5] += random.normal(0, 4 * self.noise_m)
        if self.snapped == 0 and random.random() < 0.006:
            self.snapped = int(random.integers(2, 6))
        if self.snapped > 0 and now.tcp_m[0, 2] > 0.07:
            action[6] = 0.0
            self.snapped -= 1
        length = float(np.linalg.norm(action[:3]))
        action[:3] *= min(1.0, _LONGEST_M / max(length, 1e-9))
        return action


class ShardRecorder:
    """Runs episodes until the shard is full.

    Attributes:
        number: number of the shard, which fully determines its episodes.
        pictures: uint8 (views, 224, 224, 3) RGB.
        rows: states of the dtype `ROW`, (views,).
        lifted: number of episodes that lifted the named cube.
        random: random generator of this shard.
    """

    def __init__(self, number: int, views: int) -> None:
        self.pictures = np.zeros((views, SIDE_PX, SIDE_PX, 3), dtype=np.uint8)
        self.rows = np.zeros(views, dtype=ROW)
        self.lifted = 0
        self.number, self._views, self._count = number, views, 0
        self.random = np.random.default_rng([number, 0x7265])
        self._controller = UrdfController(None, profile())
        self._controller.load()
        self._seed = 0

    def run(self, tell: Callable[[int], object]) -> None:
        """Fill the arrays."""
        for episode in range(SEEDS_PER_SHARD):
            if self.is_full:
                return
            self._seed = FIRST_SEED + SEEDS_PER_SHARD * self.number + episode
            with ArmSimulation(self._seed, engine="pybullet") as simulation:
                target = self.choose(simulation)
                if self.random.random() < 0.65:
                    self._wander(simulation, target)
                self.pick(simulation, target)
                self.lifted += simulation.cubes()[target].held_s > 0.3
            tell(self._count)

    def choose(self, simulation: ArmSimulation) -> str:
        """Choose the cube to be named."""
        return COLOURS[int(self.random.integers(len(COLOURS)))]

    @property
    def is_full(self) -> bool:
        """True if all views are recorded."""
        return self._count == self._views

    def _wander(self, simulation: ArmSimulation, target: str) -> None:
        """Move somewhere first, so that demonstrations start everywhere."""
        random = self.random
        cube = simulation.cubes()[target].position_m
        if random.random() < 0.6:
            goal = np.array([*(cube[:2] + random.normal(0, 0.05, 2)), random.uniform(0.09, 0.25)])
        else:
            goal = np.array(
                [random.uniform(0.30, 0.66), random.uniform(-0.3, 0.3), random.uniform(0.09, 0.5)]
            )
        turn_left = random.uniform(-0.8, 0.8)
        for _ in range(20):
            move = goal - simulation.tcp_pose().position_m
            distance = float(np.linalg.norm(move))
            if distance < 0.01:
                return
            turn = float(np.clip(turn_left, -0.15, 0.15))
            turn_left -= turn
            move *= min(1.0, 0.06 / distance)
            if random.random() < 0.25:
                self.keep(simulation, target)
            self.execute(simulation, np.array([*move, 0.0, 0.0, turn, 1.0]))

    def pick(self, simulation: ArmSimulation, target: str) -> None:
        """Run one episode."""
        random = self.random
        disturbance = _Disturbance(random, float(random.choice([0.0, 0.003, 0.006, 0.012])))
        held_steps = 0
        for _ in range(_MOST_STEPS):
            now = situations(self.look(simulation, target)[None], COLOURS.index(target))
            near = float(np.linalg.norm(now.to_cube_m)) < 0.10
            if random.random() < (0.7 if near else 0.35):
                self.keep(simulation, target)
            held_steps += simulation.cubes()[target].held_s > 0.5
            if held_steps > 3 or self.is_full:
                return
            self.execute(simulation, disturbance.apply(act(now)[0], now))

    def execute(self, simulation: ArmSimulation, action: F64) -> None:
        """Execute one action (7,) of the contract for `STEP_S`."""
        joints = JointSample(names=JOINTS, position=simulation.joint_positions(), stamp_ns=0)
        command = self._controller.compute(Action.from_vector(action), joints, STEP_S)
        if isinstance(command, Hold):
            simulation.hold()
        else:
            simulation.set_target(command.names, command.position, command.duration_s)
        simulation.step(_TICKS)

    def keep(self, simulation: ArmSimulation, target: str) -> U8 | None:
        """Render and store an image, and return it; None if the shard is full. The other cubes are
        moved first, so that each image has new positions.
        """
        if self.is_full:
            return None
        self._scatter(simulation, target)
        self.rows[self._count] = self.look(simulation, target)
        picture: U8 = simulation.render("front", SIDE_PX, SIDE_PX)
        self.pictures[self._count] = picture
        self._count += 1
        return picture

    def _scatter(self, simulation: ArmSimulation, target: str) -> None:
        cubes, tcp = simulation.cubes(), simulation.tcp_pose().position_m
        taken = [cubes[target].position_m[:2]]
        if tcp[2] < 0.14:
            taken.append(tcp[:2])
        poses = {}
        for name, cube in cubes.items():
            if name == target:
                continue
            for _ in range(200):
                place = np.array(
                    [self.random.uniform(*REGION_X_M), self.random.uniform(*REGION_Y_M)]
                )
                if min(float(np.hypot(*(place - other))) for other in taken) >= SPACING_M:
                    break
            else:
                return  # no free place this time: they stay where they are
            taken.append(place)
            half_yaw = self.random.uniform(-np.pi / 8, np.pi / 8)
            poses[name] = (
                (float(place[0]), float(place[1]), cube.edge_m / 2),
                (0.0, 0.0, float(np.sin(half_yaw)), float(np.cos(half_yaw))),
            )
        simulation.world.set_cubes(poses)

    def look(self, simulation: ArmSimulation, target: str) -> NDArray[np.void]:
        """State at this moment, of the dtype `ROW`."""
        row = np.zeros((), dtype=ROW)
        pose, cubes = simulation.tcp_pose(), simulation.cubes()
        row["tcp_m"], row["rotation"] = (
            pose.position_m,
            matrix_from_quaternion(pose.quaternion_xyzw),
        )
        row["opening"], row["target"], row["seed"] = (
            simulation.gripper_open(),
            COLOURS.index(target),
            self._seed,
        )
        for index, name in enumerate(COLOURS):
            cube = cubes[name]
            row["cube_m"][index], row["edge_m"][index] = cube.position_m, cube.edge_m
            row["cube_yaw_rad"][index] = yaw_of(matrix_from_quaternion(cube.quaternion_xyzw))
        return row
