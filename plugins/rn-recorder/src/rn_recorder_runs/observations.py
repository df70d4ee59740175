"""A backend's inputs in a run, reconstructed from the run's streams."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from rn_recorder_runs.episodes import RecordedPrediction, read_streams, stamp_of
from rn_recorder_runs.files import Record, read_records
from rn_recorder_runs.images import pixels_of
from rn_recorder_runs.reading import RecordDecoder, camera_of
from roboneuron import (
    ACTION_LABEL,
    F64,
    Ahead,
    ArmState,
    CameraProfile,
    Frame,
    InvalidInputError,
    JointSample,
    Observation,
    Pose,
    RobotProfile,
    channel_keys,
)

_RECENT = 90
"""Number of undecoded images kept per camera."""


class _Pose(TypedDict):
    """A pose, as written by `predictions`."""

    position_m: list[float]
    quaternion_xyzw: list[float]
    stamp_ns: int


class _Ahead(TypedDict):
    """The rows being played, as written by `predictions`."""

    rows: list[list[float]]
    committed_rows: int
    step_s: float
    context_row: int
    state_ahead_s: float


@dataclass(frozen=True, slots=True)
class Gaps:
    """Missing parts of the backend's inputs in a run: messages lost during the recording.

    Attributes:
        predictions: number of missing ones by the publisher's count; their answers are unknown.
        without_image: predictions with a missing input image, which are not compared.
        first_ns: time of the first of both [ns]; None for none.
    """

    predictions: int = 0
    without_image: int = 0
    first_ns: int | None = None


class Observations:
    """The observations of a run, in the order of its predictions.

    Args:
        files: files of the run.
        cameras: camera by role, as required by the backend.
        optional: roles that may be missing.
        profile: profile of the robot, with the cameras' mounts and the gripper.

    Raises:
        InvalidInputError: the run contains no predictions.
    """

    def __init__(
        self,
        files: Sequence[Path],
        cameras: Mapping[str, CameraProfile],
        optional: frozenset[str],
        profile: RobotProfile,
    ) -> None:
        self._files, self._cameras, self._optional, self._profile = (
            files,
            cameras,
            optional,
            profile,
        )
        self._streams = read_streams(files)
        if not self._streams.predictions:
            raise InvalidInputError(
                "The run holds no predictions, so nobody knows what the backend saw.",
                hint="They are recorded while a backend runs; check `topics` in [recorder], and "
                "that rn-recorder is "
                "installed for the interpreter of the inference module.",
            )
        predictions = self._streams.predictions
        self._used = {
            f["camera"] for prediction in predictions for f in prediction.facts["frames"].values()
        }
        """Cameras of the recorded backend; its unused ones are left out."""
        self._there = {
            camera: {stamp for _, stamp in seen} for camera, seen in self._streams.images.items()
        }
        self.gaps = self._find_gaps()
        """Missing messages of the run."""
        self.labels = tuple(
            dict.fromkeys(label_of(one.facts) for one in predictions if "rows" in one.facts)
        )
        """Control spaces of the recorded answers."""
        self._decoder = RecordDecoder()
        self._recent: dict[str, deque[tuple[int, Record]]] = {}
        self._infos: dict[str, Any] = {}

    def _lacks_image(self, prediction: RecordedPrediction) -> bool:
        frames = prediction.facts["frames"].values()
        return any(int(f["stamp_ns"]) not in self._there.get(f["camera"], set()) for f in frames)

    def _find_gaps(self) -> Gaps:
        lost, incomplete, at_ns = 0, 0, list[int]()
        before = 0
        for prediction in self._streams.predictions:
            if 0 < before < prediction.sequence - 1:
                lost += prediction.sequence - 1 - before
                at_ns.append(prediction.at_ns)
            before = prediction.sequence
            if self._lacks_image(prediction):
                incomplete += 1
                at_ns.append(prediction.at_ns)
        return Gaps(lost, incomplete, min(at_ns, default=None))

    def __iter__(self) -> Iterator[tuple[RecordedPrediction, Observation]]:
        """Yield each recorded prediction with its reconstructed observation; those with a lost
        image are left out (see `gaps`).

        Raises:
            InvalidInputError: every prediction lacks an image, or images come in another order than
                predictions.
        """
        if self.gaps.without_image == len(self._streams.predictions):
            raise InvalidInputError(
                f"The run lacks an image of each of its {self.gaps.without_image} predictions.",
                hint="Record the images as well: `topics` and `exclude` in [recorder].",
            )
        records = (
            record
            for path in self._files
            for record in read_records(path, self._decoder.definitions)
        )
        self._recent.clear()
        for prediction in self._streams.predictions:
            if self._lacks_image(prediction):
                continue
            stamps = {f["camera"]: int(f["stamp_ns"]) for f in prediction.facts["frames"].values()}
            while not all(self._find(camera, stamp) for camera, stamp in stamps.items()):
                record = next(records, None)
                if record is None:
                    raise InvalidInputError(
                        f"The run lacks an image that the backend saw at {prediction.at_ns}."
                    )
                self._note(record)
            yield prediction, self._observation(prediction, stamps)

    def _note(self, record: Record) -> None:
        camera = camera_of(record.topic)
        if camera:
            self._recent.setdefault(camera, deque(maxlen=_RECENT)).append(
                (stamp_of(record.data), record)
            )
        elif record.topic.endswith("/camera_info"):
            self._infos[record.topic.split("/")[-2]] = self._decoder.decode(record)

    def _find(self, camera: str, stamp_ns: int) -> Record | None:
        return next(
            (record for stamp, record in self._recent.get(camera, ()) if stamp == stamp_ns), None
        )

    def _observation(
        self, prediction: RecordedPrediction, stamps: Mapping[str, int]
    ) -> Observation:
        facts = prediction.facts
        newest_ns = max(stamps.values(), default=int(facts["stamp_ns"]))
        frames = {}
        for role, camera in self._cameras.items():
            record = self._find(camera.name, stamps.get(camera.name, -1))
            if record is None and not (role in self._optional and camera.name in self._used):
                record = self._before(camera.name, newest_ns)
            if record is not None:
                frames[role] = self._frame(record, camera)
            elif role not in self._optional:
                raise InvalidInputError(
                    f"The run holds no images of camera {camera.name!r} (role {role!r})."
                )
        joints, pose, ahead = facts.get("joints"), facts.get("ee_pose"), facts.get("ahead")
        return Observation(
            frames=frames,
            instruction=facts["instruction"],
            joints=self._joints(joints, prediction.at_ns),
            ee_pose=None if pose is None else _pose(pose),
            gripper_open=facts.get("gripper_open"),
            arms={
                name: ArmState(ee_pose=_pose(told), gripper_open=told["gripper_open"])
                for name, told in facts.get("arms", {}).items()
            },
            stamp_ns=min(frame.stamp_ns for frame in frames.values()),
            ahead=None if ahead is None else _ahead(ahead),
        )

    def _before(self, camera: str, stamp_ns: int) -> Record | None:
        """The newest image of a camera that the recorded backend did not use."""
        return next(
            (
                record
                for stamp, record in reversed(self._recent.get(camera, ()))
                if stamp <= stamp_ns
            ),
            None,
        )

    def _frame(self, record: Record, camera: CameraProfile) -> Frame:
        from roboneuron.command import messages  # heavy

        message = self._decoder.decode(record)
        image = pixels_of(message, record.type)
        height, width = image.shape[:2]
        calibration, info = camera.calibration_at(width, height), self._infos.get(camera.name)
        if (
            calibration is not None
            and info is not None
            and (info.width, info.height) == (width, height)
        ):
            calibration = replace(
                calibration, intrinsics=messages.intrinsics_from_camera_info(info)
            )
        return Frame(
            camera=camera.name,
            image=image,
            stamp_ns=stamp_of(record.data),
            frame_id=message.header.frame_id or camera.name,
            calibration=calibration,
        )

    def _joints(self, told: Mapping[str, Any] | None, at_ns: int) -> JointSample | None:
        if told is not None:
            velocity = told.get("velocity")
            return JointSample(
                names=tuple(told["names"]),
                position=np.array(told["position"], dtype=np.float64),
                velocity=None if velocity is None else np.array(velocity, dtype=np.float64),
                stamp_ns=int(told["stamp_ns"]),
            )
        newest = next(
            ((at, joints) for at, joints in reversed(self._streams.joints) if at <= at_ns), None
        )
        if newest is None:
            return None
        return JointSample(names=self._streams.joint_names, position=newest[1], stamp_ns=newest[0])


def _pose(told: _Pose) -> Pose:
    return Pose(
        position_m=np.array(told["position_m"], dtype=np.float64),
        quaternion_xyzw=np.array(told["quaternion_xyzw"], dtype=np.float64),
        stamp_ns=int(told["stamp_ns"]),
    )


def _ahead(told: _Ahead) -> Ahead:
    return Ahead(
        rows=to_rows(told["rows"], len(channel_keys(ACTION_LABEL))),
        committed_rows=int(told["committed_rows"]),
        step_s=float(told["step_s"]),
        context_row=int(told["context_row"]),
        state_ahead_s=float(told["state_ahead_s"]),
    )


def to_rows(told: Sequence[Sequence[float]], size: int) -> F64:
    """Parse rows from JSON to float64 (H, n); `size` is n if there are none."""
    return np.array(told, dtype=np.float64) if told else np.zeros((0, size))


def label_of(facts: Mapping[str, object]) -> str:
    """Label of the control space of a recorded prediction."""
    return str(facts.get("space", ACTION_LABEL))
