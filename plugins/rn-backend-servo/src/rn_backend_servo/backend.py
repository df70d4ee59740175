"""The backend "servo": passes instruction, images and proprioception to the policy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rn_backend_servo.episode import EpisodeBackend
from rn_backend_servo.instruction import parse_instruction
from rn_backend_servo.options import ServoOptions
from rn_backend_servo.phases import Phase
from rn_backend_servo.policy import PickPolicy, ServoMotion
from rn_backend_servo.sight import look, not_visible
from rn_backend_servo.watch import FrameWatch
from roboneuron import (
    ActionChunk,
    Ahead,
    AnyAcceleration,
    AnyRuntime,
    InvalidInputError,
    Observation,
    Pose,
    UngroundedError,
    UnsafeError,
    matrix_from_rotvec,
)
from roboneuron.sight.pose_history import PoseHistory

F64 = NDArray[np.float64]

_HALF_A_ROW = 0.5
"""Delay of the first row after an image: up to one period, half a period on average."""


def kept_rows(ahead: Ahead | None, count: int) -> F64:
    """First rows (N, 7) of a chunk of `count` rows; none if they would fill it."""
    if ahead is None or ahead.committed_rows >= count:
        return np.zeros((0, 7))
    return ahead.rows[: ahead.committed_rows]


def pose_after(tcp: F64, rows: F64, done_rows: float) -> F64:
    """Predict the TCP pose after `rows`.

    Args:
        tcp: measured TCP pose (4, 4).
        rows: float64 (N, 7), oldest first; the first one was due next when the image was taken.
        done_rows: number of rows executed when the pose was measured; a fraction scales a row.

    Returns:
        (4, 4).
    """
    after = tcp.copy()
    for i, row in enumerate(rows):
        left = float(np.clip(i + 1 - done_rows, 0.0, 1.0))
        after[:3, 3] += left * row[:3]
        after[:3, :3] = matrix_from_rotvec(left * row[3:6]) @ after[:3, :3]
    return after


def rows_done(pose_ns: int, captured_ns: int, step_s: float) -> float:
    """Rows executed between the capture of an image and the measurement of a pose; at least 0."""
    return max(0.0, (pose_ns - captured_ns) / 1e9 / step_s - _HALF_A_ROW)


def chunk_rows(policy: PickPolicy, motion: ServoMotion, start: F64, kept: F64, count: int) -> F64:
    """Rows (`count`, 7): `kept`, then `motion` from `start` (4, 4), then further motions towards
    the same goal.
    """
    rows = list(kept)
    here = start
    while len(rows) < count:
        row = np.concatenate([motion.translation_m, motion.rotation_rad, [motion.gripper_open]])
        rows.append(row)
        here = pose_after(here, row[None], 0.0)
        motion = policy.continued(motion, here)
    return np.array(rows)


class ServoBackend(EpisodeBackend):
    """Picks up the cube named by the instruction; uses only images, TCP pose and gripper opening.

    One action per prediction, or `rows` of them, each at most `max_step_m` long. A chunk of several
    rows continues the rows executed during inference (`Observation.ahead`) and then moves from
    their end to the goal. An error does not change the state machine, so the episode continues when
    the cause (a black image, a hidden cube) is gone.
    """

    name = "servo"

    def __init__(
        self,
        config: ServoOptions | None,
        runtime: AnyRuntime | None = None,
        acceleration: AnyAcceleration | None = None,
    ) -> None:
        super().__init__()
        self._options = config or ServoOptions()
        self._policy = PickPolicy(self._options)
        self._history = PoseHistory()
        self._watches: dict[str, FrameWatch] = {}

    def forget(self) -> None:
        """See `EpisodeBackend`."""
        self._policy.reset()
        self._history.clear()
        self._watches.clear()

    def predict(self, observation: Observation) -> ActionChunk:
        """Return the next small motions of the TCP.

        Raises:
            UngroundedError: no sensible action follows from the instruction or the images, or
                several grasps failed.
            InvalidInputError: the primary image, the TCP pose or the gripper opening is absent.
            UnsafeError: the state is not finite.
            StateError: not loaded.
        """
        self.check_loaded()
        pose, gripper_open = _state(observation)
        colour = parse_instruction(observation.instruction)
        self.follow(observation.instruction)
        self._history.add(pose)
        places = {
            role: self._history.at(frame.stamp_ns) for role, frame in observation.frames.items()
        }
        newest_ns = max(frame.stamp_ns for frame in observation.frames.values())
        for role, frame in observation.frames.items():
            is_fixed = frame.calibration is not None and frame.calibration.mount == "base"
            must_change = is_fixed or self._policy.episode.phase in (Phase.APPROACH, Phase.DESCEND)
            watch = self._watches.setdefault(role, FrameWatch())
            watch.check(frame, pose, places[role], newest_ns=newest_ns, must_change=must_change)
        primary = observation.frames["primary"]
        if primary.calibration is None:
            raise UngroundedError(
                f"Camera {primary.camera!r} is not calibrated, so the cube cannot be located.",
                hint="Give the robot's profile a calibration for this image size.",
            )
        sighting = look(observation.frames, places, colour, self._options)
        if sighting is None and self._policy.episode.phase is Phase.SEARCH:
            raise not_visible(observation.frames, colour)
        options = self._options
        tcp, kept = pose.matrix, kept_rows(observation.ahead, options.rows)
        start = pose_after(tcp, kept, rows_done(pose.stamp_ns, primary.stamp_ns, options.step_s))
        motion = self._policy.step(sighting, tcp, gripper_open, start)
        episode = self._policy.episode
        return ActionChunk(
            actions=chunk_rows(self._policy, motion, start, kept, options.rows),
            step_s=options.step_s,
            metrics={
                "remaining_m": motion.remaining_m,
                "failed_attempts": float(episode.attempts),
                "is_visible": float(sighting is not None),
                "done": float(episode.phase is Phase.HOLD),
                "misfit_px": sighting.estimate.misfit_px if sighting else 0.0,
            },
            note=f"{episode.phase.value} {colour} cube",
            conditioned_rows=len(kept),
        )


def _state(observation: Observation) -> tuple[Pose, float]:
    """TCP pose and gripper opening, present and finite."""
    if "primary" not in observation.frames:
        raise InvalidInputError("The observation has no frame of role 'primary'.", path="frames")
    pose, gripper_open = observation.ee_pose, observation.gripper_open
    if pose is None:
        raise InvalidInputError(
            "The observation has no ee_pose.", hint="Is control running?", path="ee_pose"
        )
    if gripper_open is None:
        raise InvalidInputError("The observation has no gripper_open.", path="gripper_open")
    values = np.concatenate([pose.position_m, pose.quaternion_xyzw, [gripper_open]])
    if not np.isfinite(values).all():
        raise UnsafeError(f"The measured state is not finite: {values.tolist()}.")
    return pose, gripper_open
