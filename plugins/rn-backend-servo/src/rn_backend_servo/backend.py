"""The backend "servo": passes instruction, images and proprioception to the policy."""

from __future__ import annotations

import numpy as np

from rn_backend_servo.chunk import chunk_rows, kept_rows, pose_after, rows_done
from rn_backend_servo.episode import EpisodeBackend
from rn_backend_servo.instruction import parse_instruction
from rn_backend_servo.options import ServoOptions
from rn_backend_servo.phases import Phase
from rn_backend_servo.policy import PickPolicy
from rn_backend_servo.sight import look, not_visible
from rn_backend_servo.watch import FrameWatch
from rn_standard.sight.pose_history import PoseHistory
from rn_standard.sight.view import matrix_of
from roboneuron import (
    ActionChunk,
    AnyAcceleration,
    AnyRuntime,
    InvalidInputError,
    Observation,
    Pose,
    UngroundedError,
    UnsafeError,
)


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
        tcp, kept = matrix_of(pose), kept_rows(observation.ahead, options.rows)
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
