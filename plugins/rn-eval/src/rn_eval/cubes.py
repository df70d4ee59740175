"""The suite "cubes": the simulated FR3 has to pick up one of several cubes; the simulator
judges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from rn_eval.arm import DeployedArm
from rn_eval.domain_shift import DomainShift, Shift
from rn_eval.suite import Episode, Judgement, Setup
from rn_robot_fr3.cameras import cell_cameras
from rn_robot_fr3.cell import FR3, Workcell
from rn_robot_fr3.simulation import STEP_S, ArmSimulation
from rn_simulation.cubes import DEFAULT_COLOURS, RGBA_BY_COLOUR
from roboneuron import (
    ArmState,
    Frame,
    JointSample,
    Observation,
    matrix_from_quaternion,
)
from roboneuron.command import poses_of

F64 = NDArray[np.float64]

PLAIN = "pick up the {colour} cube"
WORDINGS = (
    PLAIN,
    "grab the {colour} cube",
    "lift the {colour} block",
    "please take the {colour} cube",
    "fetch the small {colour} block",
    "grasp the {colour} box and lift it",
    "get the {colour} cube from the table",
    "raise the {colour} cube",
)
"""Sentences for `wordings = "varied"`."""
_DRAW = 0x63756265
"""Separates this suite's random numbers from those of the scene, which has the same seed."""


class CubesOptions(BaseModel):
    """Options of the suite `cubes`, given as `--suite-option NAME=VALUE`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    objects: int = Field(
        default=4, ge=1, le=6, description="cubes on the table; all but the named one distract"
    )
    colours: tuple[str, ...] = Field(
        default=DEFAULT_COLOURS, description="colours that the cubes are drawn from"
    )
    wordings: Literal["plain", "varied"] = Field(
        default="plain", description="one sentence, or one of eight"
    )
    image_px: int = Field(default=224, ge=64, le=1024, description="width and height of the images")
    camera_hz: float = Field(default=30.0, gt=0, le=120, description="images per simulated second")
    engine: Literal["auto", "pybullet", "mujoco"] = Field(
        default="auto", description="physics engine"
    )
    time_limit_s: float = Field(
        default=30.0, gt=0, le=600, description="an episode fails after this long"
    )
    held_s: float = Field(
        default=1.0, gt=0, le=10, description="how long the cube must be held 10 cm up"
    )

    shift: Shift = Field(
        default="none",
        description="what differs from training: camera beside the table, light, table, noise",
    )
    displaced_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = Field(
        default=(0.0, 0.0, 0.0),
        description="where the camera beside the table is in every episode, relative to its "
        "calibration, in the base frame [m]",
    )

    @model_validator(mode="after")
    def _check(self) -> CubesOptions:
        unknown = [colour for colour in self.colours if colour not in RGBA_BY_COLOUR]
        if unknown or len(set(self.colours)) != len(self.colours):
            raise ValueError(
                f"colours are {list(self.colours)}, expected different ones of "
                f"{list(RGBA_BY_COLOUR)}"
            )
        if self.objects > len(self.colours):
            raise ValueError(
                f"{self.objects} objects need as many colours, {len(self.colours)} are given"
            )
        return self


class Cubes:
    """Follows the protocol `Suite`. The named colour cycles with the seed.

    Attributes:
        phrase: the plain instruction.
        verb: prefix of its task names.
    """

    phrase: ClassVar[str] = PLAIN
    verb: ClassVar[str] = "pick"

    def __init__(self, config: CubesOptions | None) -> None:
        self._options = config or CubesOptions()

    def episodes(self, count: int, first_seed: int) -> Sequence[Episode]:
        """One episode per seed, beginning with `first_seed`."""
        return [self._episode(seed) for seed in range(first_seed, first_seed + count)]

    def open(self, episode: Episode, setup: Setup) -> CubesScene:
        """Build the world with the cubes of the seed."""
        target = self._target(episode.seed)
        return CubesScene(
            episode, target, self._on_table(episode.seed, target), self._options, setup
        )

    def close(self) -> None:
        """Do nothing; the suite holds no resources."""

    def _target(self, seed: int) -> str:
        return self._options.colours[seed % len(self._options.colours)]

    def _on_table(self, seed: int, target: str) -> tuple[str, ...]:
        """Colours on the table, in the order of the option; with all of them the scene equals that
        of `roboneuron demo`.
        """
        others = [colour for colour in self._options.colours if colour != target]
        drawn = np.random.default_rng([_DRAW, seed]).permutation(others)[
            : self._options.objects - 1
        ]
        return tuple(
            colour for colour in self._options.colours if colour == target or colour in drawn
        )

    def _episode(self, seed: int) -> Episode:
        target = self._target(seed)
        wording = self.phrase
        if self._options.wordings == "varied":
            drawn = np.random.default_rng([_DRAW + 1, seed])
            wording = WORDINGS[int(drawn.integers(len(WORDINGS)))]
        return Episode(
            task=f"{self.verb}-{target}",
            seed=seed,
            instruction=wording.format(colour=target),
            time_limit_s=self._options.time_limit_s,
        )


class CubesScene:
    """One open scene; follows the protocol `Scene`.

    Attributes:
        cell: the arms at the table.
    """

    cell: ClassVar[Workcell] = FR3
    tick_s = STEP_S
    judge_ticks = max(1, round(0.1 / STEP_S))

    def __init__(
        self,
        episode: Episode,
        target: str,
        colours: Sequence[str],
        options: CubesOptions,
        setup: Setup,
    ) -> None:
        """Build the world. Raises ConfigurationError if the engine is not installed."""
        self.camera_ticks = max(1, round(1.0 / (options.camera_hz * STEP_S)))
        self._episode, self._target, self._options, self._setup = episode, target, options, setup
        size = options.image_px
        self._calibrations = {
            role: camera.calibration_at(size, size) for role, camera in setup.cameras.items()
        }
        assert setup.controller is not None  # because the FR3 is an installed robot
        self._controller = setup.controller
        self._arm = DeployedArm(setup, setup.controller)
        self._poses = poses_of(setup.controller)
        self._shift = DomainShift(options.shift, episode.seed)
        cameras = [camera.displaced(options.displaced_m) for camera in cell_cameras(self.cell)]
        self._simulation = ArmSimulation(
            episode.seed,
            colours=colours,
            engine=options.engine,
            cell=self.cell,
            cameras=self._shift.cameras(cameras),
        )
        self._simulation.open()
        self._turned_rad = self._turn_to_target()

    def observe(self, stamp_ns: int) -> Observation:
        """Images of every camera and the measured state, at the same instant."""
        size = self._options.image_px
        frames = {
            role: Frame(
                camera=camera.name,
                image=self._shift.image(self._simulation.render(camera.name, size, size)),
                stamp_ns=stamp_ns,
                frame_id=camera.frame_id,
                calibration=self._calibrations[role],
            )
            for role, camera in self._setup.cameras.items()
        }
        state: Mapping[str, object] = {}
        if self._setup.needs_state:
            joints, profile = self._joints(stamp_ns), self._setup.profile
            arms = [
                ArmState(
                    ee_pose=pose,
                    gripper_open=arm.opening_in(joints),
                )
                for arm, pose in zip(profile.each_arm, self._poses(joints), strict=True)
            ]
            state = {
                "joints": joints,
                "ee_pose": arms[0].ee_pose,
                "gripper_open": arms[0].gripper_open,
                "arms": {arm.name: told for arm, told in zip(profile.arms, arms, strict=False)},
            }
        return Observation(
            frames=frames,
            instruction=self._episode.instruction,
            stamp_ns=stamp_ns,
            **state,  # type: ignore[arg-type]
        )

    def act(self, vector: F64, now_s: float) -> str:
        """Send an action through controller and limits to the simulated driver."""
        command, word = self._arm.command(vector, self._joints(round(now_s * 1e9)), now_s)
        if command is not None:
            self._simulation.set_target(command.names, command.position, command.duration_s)
        return word

    def watch(self, now_s: float) -> None:
        """Hold the arm if actions have stopped coming."""
        command = self._arm.watch(self._joints(round(now_s * 1e9)), now_s)
        if command is not None:
            self._simulation.set_target(command.names, command.position, command.duration_s)

    def advance(self, ticks: int) -> None:
        """Step the physics."""
        self._simulation.step(ticks)

    def judge(self) -> Judgement:
        """Success: the named cube was held long enough. Failure: another one was."""
        cubes = self._simulation.cubes()
        held = next(
            (name for name, cube in cubes.items() if cube.held_s >= self._options.held_s), None
        )
        highest = max(cubes.values(), key=lambda cube: cube.lifted_m)
        facts: dict[str, str | float] = {
            "target": self._target,
            "objects": float(len(cubes)),
            "turned_rad": round(self._turned_rad, 4),
            "lifted_cm": round(max(0.0, cubes[self._target].lifted_m) * 100, 2),
        }
        if highest.lifted_m >= 0.02:  # something was lifted: was it the named cube?
            facts["right_object"] = float(highest.name == self._target)
        if held == self._target:
            return Judgement(success=True, is_over=True, facts=facts)
        reason = (
            f"The {self._target} cube was lifted by {facts['lifted_cm']:.1f} cm when time was up."
        )
        if held is not None:
            reason = f"The {held} cube was lifted instead of the {self._target} one."
        return Judgement(success=False, is_over=held is not None, reason=reason, facts=facts)

    def state(self) -> bytes:
        """Joint and cube poses, bit for bit."""
        poses = self._simulation.world.cube_poses()
        cubes = b"".join(np.concatenate(poses[name]).tobytes() for name in sorted(poses))
        return self._simulation.joint_positions().tobytes() + cubes

    def close(self) -> None:
        """Destroy the world."""
        self._simulation.close()

    def _turn_to_target(self) -> float:
        """Angle between the fingers and the nearest side of the named cube, 0 .. pi / 4 [rad]; both
        are level at the start.
        """
        hand = matrix_from_quaternion(self._controller.forward(self._joints(0)).quaternion_xyzw)
        cube = next(cube for cube in self._simulation.scene if cube.name == self._target)
        angle = cube.yaw_rad - math.atan2(hand[1, 0], hand[0, 0])
        return abs(math.remainder(angle, math.pi / 2))

    def _joints(self, stamp_ns: int) -> JointSample:
        position, velocity = self._simulation.joint_states()
        return JointSample(
            names=self.cell.joints, position=position, velocity=velocity, stamp_ns=stamp_ns
        )
