"""Evaluation of a deployed backend on the frames of a demonstration, as in the server."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_recorder_policy.answers import Answers
from rn_recorder_policy.demonstration import ACTION, IMAGES, Demonstration
from rn_recorder_policy.name_mapping import POSITION, QUATERNION, NameMapping, RecordedStates
from rn_recorder_runs.deployed import DeployedBackend
from roboneuron import (
    ActionChunk,
    ArmProfile,
    ArmState,
    ConfigurationError,
    Frame,
    InvalidInputError,
    JointSample,
    Observation,
    Pose,
    RoboNeuronError,
    matrix_from_quaternion,
)

F64 = NDArray[np.float64]
LEAST_FRAMES = 10
"""Minimum number of answers for a statement on scale and lag."""
_NS = 1_000_000_000


@dataclass(frozen=True, kw_only=True, slots=True)
class BackendQuery:
    """Parameters of the evaluation.

    Attributes:
        mapping: mapping of names.
        feature: the feature with the actions.
        cameras: image feature by role of the backend, if the names differ.
        frames: number of observations of the episode.
        instruction: in place of the recorded one.
    """

    mapping: NameMapping
    feature: str = ACTION
    cameras: Mapping[str, str]
    frames: int = 50
    instruction: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class BackendReplies:
    """Answers and refusals.

    Attributes:
        refused: frames that the backend refused.
        refusal: reason of the first refusal.
    """

    answers: Answers
    refused: int
    refusal: str


def ask(
    deployed: DeployedBackend, demonstration: Demonstration, question: BackendQuery
) -> BackendReplies:
    """Evaluate a loaded backend on equidistant frames; it is reset before each one, so that an
    answer depends on its frame only.

    Raises:
        InvalidInputError: names, cameras or instruction are missing; or too few answers came.
        RoboNeuronError: as the backend.
    """
    if demonstration.rows < LEAST_FRAMES:
        raise InvalidInputError(
            f"{demonstration.source} has {demonstration.rows} rows, {LEAST_FRAMES} are needed.",
            hint="Choose a longer episode.",
        )
    space = deployed.agreement.executed
    recorded = question.mapping.actions(demonstration, question.feature, space)
    states = question.mapping.states(demonstration, deployed.profile)
    observations = _Observations(deployed, demonstration, states, question)
    rows = np.unique(np.linspace(0, demonstration.rows - 1, question.frames).round().astype(int))
    observations.read(rows.tolist())
    answered: list[int] = []
    chunks: list[ActionChunk] = []
    refusal = ""
    for row in rows.tolist():
        observation = observations.at(row)
        deployed.backend.reset()
        try:
            answer = deployed.backend.predict(observation)
        except RoboNeuronError as error:
            refusal = refusal or str(error)
            continue
        chunks.append(deployed.agreement.convert(answer, observation.joints))
        answered.append(row)
    if len(chunks) < LEAST_FRAMES:
        told = f" The backend says: {refusal}" if refusal else ""
        raise InvalidInputError(
            f"{len(chunks)} of {len(rows)} frames were answered, {LEAST_FRAMES} are needed.{told}",
            hint=f"Of the state the data set names: {', '.join(states.values) or 'nothing'}. "
            "Map others with --map.",
        )
    horizon = min(len(chunk.actions) for chunk in chunks)
    joints = np.full_like(recorded, np.nan)
    for place, channel in enumerate(space.channels):
        # names of joints already belong to one arm
        if channel.name in deployed.profile.arm_joints and channel.name in states.values:
            joints[:, place] = states.values[channel.name]
    orientations = states.stacked(QUATERNION)
    answers = Answers(
        space=space,
        step_s=chunks[0].step_s,
        fps=demonstration.fps,
        frames=np.array(answered, dtype=np.int64),
        predicted=np.stack([chunk.actions[:horizon] for chunk in chunks]),
        recorded=recorded,
        joints=joints,
        positions_m=states.stacked(POSITION),
        orientations=None
        if orientations is None
        else np.stack([matrix_from_quaternion(q) for q in orientations]),
    )
    return BackendReplies(answers=answers, refused=len(rows) - len(chunks), refusal=refusal)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _ArmStates:
    """Recorded state of one arm; None for missing parts.

    Attributes:
        positions_m, quaternions: of the TCP, base frame, float64 (n, 3) and (n, 4).
        openings: 0 closed .. 1 open, float64 (n,).
    """

    positions_m: F64 | None
    quaternions: F64 | None
    openings: F64 | None

    @classmethod
    def of(cls, arm: ArmProfile, states: RecordedStates) -> _ArmStates:
        """State of an arm, by the names of its channels."""

        def stacked(names: Sequence[str]) -> F64 | None:
            return states.stacked([f"{arm.name}/{x}" if arm.name else x for x in names])

        return cls(
            positions_m=stacked(POSITION),
            quaternions=stacked(QUATERNION),
            openings=states.openings(arm),
        )

    def at(self, row: int, stamp_ns: int) -> tuple[Pose | None, float | None]:
        """TCP pose and opening of a row."""
        pose = None
        if self.positions_m is not None and self.quaternions is not None:
            pose = Pose(
                position_m=self.positions_m[row],
                quaternion_xyzw=self.quaternions[row],
                stamp_ns=stamp_ns,
            )
        return pose, None if self.openings is None else float(self.openings[row])


class _Observations:
    """Observations of a demonstration, with the inputs that the backend's descriptor requires."""

    def __init__(
        self,
        deployed: DeployedBackend,
        demonstration: Demonstration,
        states: RecordedStates,
        question: BackendQuery,
    ) -> None:
        self._deployed, self._demonstration = deployed, demonstration
        self._instruction = question.instruction or demonstration.instruction
        if not self._instruction:
            raise InvalidInputError(
                f"{demonstration.source} tells no instruction.", hint="Give --instruction."
            )
        profile = deployed.profile
        self._joints = states.stacked(profile.arm_joints)
        self._names = profile.arm_joints
        self._arms = {arm.name: _ArmStates.of(arm, states) for arm in profile.each_arm}
        for arm in profile.each_arm:
            openings = self._arms[arm.name].openings
            if self._joints is not None and arm.gripper is not None and openings is not None:
                # the driver reports the gripper's joint with the arm's
                fingers = [arm.gripper.to_position(float(opening)) for opening in openings]
                self._joints = np.column_stack([self._joints, fingers])
                self._names = (*self._names, arm.gripper.joint)
        self._sources = self._choose_cameras(question.cameras)
        self._frames: dict[int, dict[str, Frame]] = {}

    def _choose_cameras(self, chosen: Mapping[str, str]) -> dict[str, str]:
        """Feature by role. Raises ConfigurationError, InvalidInputError."""
        cameras = self._demonstration.cameras
        by_name = {key.removeprefix(IMAGES): key for key in cameras}
        for role in chosen:
            if role not in self._deployed.cameras:
                raise ConfigurationError(
                    f"--camera names the role {role!r}; the backend has "
                    f"{', '.join(self._deployed.cameras) or 'none'}."
                )
        found: dict[str, str] = {}
        for role, camera in self._deployed.cameras.items():
            names = (chosen[role],) if role in chosen else (camera.name, role)
            key = next((by_name.get(n, n) for n in names if by_name.get(n, n) in cameras), None)
            if key is not None:
                found[role] = key
            elif role in chosen or role not in self._deployed.spec.optional_cameras:
                raise InvalidInputError(
                    f"{self._demonstration.source} has no pictures {' or '.join(names)} for the "
                    f"role {role!r}. It has: {', '.join(by_name) or 'none'}.",
                    hint="Name them: --camera ROLE=NAME.",
                )
        return found

    def read(self, rows: Sequence[int]) -> None:
        """Decode the images of these rows. Raises InvalidInputError, MissingDependencyError."""
        for role, key in self._sources.items():
            camera = self._deployed.cameras[role]
            images = self._demonstration.read_pictures(key, rows)
            for row, image in zip(rows, images, strict=True):
                height, width = image.shape[:2]
                self._frames.setdefault(row, {})[role] = Frame(
                    camera=camera.name,
                    image=image,
                    stamp_ns=self._stamp_ns(row),
                    frame_id=camera.frame_id or camera.name,
                    calibration=camera.calibration_at(width, height),
                )

    def _stamp_ns(self, row: int) -> int:
        return round((1 + row / self._demonstration.fps) * _NS)

    def at(self, row: int) -> Observation:
        """The observation of a decoded row."""
        stamp_ns = self._stamp_ns(row)
        joints = None
        measured: dict[str, tuple[Pose | None, float | None]] = {}
        if self._deployed.spec.needs_state:
            if self._joints is not None:
                joints = JointSample(
                    names=self._names, position=self._joints[row], stamp_ns=stamp_ns
                )
            measured = {name: arm.at(row, stamp_ns) for name, arm in self._arms.items()}
        pose, opening = next(iter(measured.values()), (None, None))
        return Observation(
            frames=self._frames.get(row, {}),
            instruction=self._instruction,
            joints=joints,
            ee_pose=pose,
            gripper_open=opening,
            arms={
                name: ArmState(ee_pose=at, gripper_open=hand)
                for name, (at, hand) in measured.items()
                if name and at is not None
            },
            stamp_ns=stamp_ns,
        )
