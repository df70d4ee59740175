"""The backend "servo-pair": passes instruction, images and the state of two arms to the hand-over
policy.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rn_backend_servo.episode import EpisodeBackend
from rn_backend_servo.geometry import F64
from rn_backend_servo.hand_over import ArmGoal, HandOverPolicy, Stage
from rn_backend_servo.instruction import parse_hand_over
from rn_backend_servo.options import HandOverOptions
from rn_backend_servo.phases import Phase
from rn_backend_servo.sight import look, not_visible
from rn_backend_servo.watch import FrameWatch
from roboneuron import (
    GRIPPER,
    ActionChunk,
    AnyAcceleration,
    AnyRuntime,
    ArmState,
    Channel,
    ControlSpace,
    InvalidInputError,
    Observation,
    RobotProfile,
    UnsafeError,
)
from roboneuron.sight.pose_history import PoseHistory


def hand_over_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    """Control space: TCP poses of both arms.

    Raises:
        InvalidInputError: the robot lacks one of them.
    """
    chosen = HandOverOptions.model_validate(options)
    names = [arm.name for arm in profile.arms]
    absent = [name for name in (chosen.giver, chosen.taker) if name not in names]
    if absent:
        raise InvalidInputError(
            f"Robot {profile.name!r} has no arm {absent[0]!r}; it has {names}.",
            hint="Name two of its arms in the options giver and taker.",
        )
    return space_of(chosen)


def space_of(options: HandOverOptions) -> ControlSpace:
    """TCP pose and opening of the giver, then of the taker."""
    channels: list[Channel] = []
    for arm in (options.giver, options.taker):
        channels += [Channel(name=name, unit="m", frame="base", arm=arm) for name in "xyz"]
        channels += [Channel(name=f"q{name}", unit="1", frame="base", arm=arm) for name in "xyzw"]
        channels.append(Channel(name=GRIPPER, unit="opening", arm=arm))
    return ControlSpace(kind="ee_pose", channels=tuple(channels))


def _value(channel: Channel, goals: Mapping[str, ArmGoal]) -> float:
    goal = goals[channel.arm]
    if channel.name == GRIPPER:
        return goal.gripper_open
    if channel.name.startswith("q"):
        return float(goal.pose.quaternion_xyzw["xyzw".index(channel.name[1])])
    return float(goal.pose.position_m["xyz".index(channel.name)])


class HandOverBackend(EpisodeBackend):
    """Hands the cube named by the instruction from one arm to the other; uses only images, TCP
    poses and openings of both arms. One row of `ee_pose` per prediction.
    """

    name = "servo-pair"

    def __init__(
        self,
        config: HandOverOptions | None,
        runtime: AnyRuntime | None = None,
        acceleration: AnyAcceleration | None = None,
    ) -> None:
        super().__init__()
        self._options = config or HandOverOptions()
        self._policy = HandOverPolicy(self._options)
        self._histories: dict[str, PoseHistory] = {}
        # by role of the camera and arm
        self._watches: dict[tuple[str, str], FrameWatch] = {}
        self._space = space_of(self._options)

    def forget(self) -> None:
        """See `EpisodeBackend`."""
        self._policy.reset()
        self._histories.clear()
        self._watches.clear()

    def predict(self, observation: Observation) -> ActionChunk:
        """Return the next small motions of both TCPs.

        Raises:
            UngroundedError: no sensible action follows from the instruction or the images (also
                repeated or frozen ones), or the cube was lost.
            InvalidInputError: the primary image or the state of one of the arms is absent.
            UnsafeError: it is not finite.
            StateError: not loaded.
        """
        self.check_loaded()
        options = self._options
        if "primary" not in observation.frames:
            raise InvalidInputError(
                "The observation has no frame of role 'primary'.", path="frames"
            )
        giver = self._state(observation, options.giver)
        taker = self._state(observation, options.taker)
        colour = parse_hand_over(observation.instruction)
        self.follow(observation.instruction)
        policy = self._policy
        places = self._watch(observation)
        sighting = None
        if policy.stage is Stage.PICK:
            sighting = look(observation.frames, places, colour, options)
            if sighting is None and policy.pick.episode.phase is Phase.SEARCH:
                raise not_visible(observation.frames, colour)
        gives, takes = policy.step(sighting, giver, taker)
        goals = {options.giver: gives, options.taker: takes}
        row = [_value(channel, goals) for channel in self._space.channels]
        return ActionChunk(
            actions=np.array([row]),
            step_s=options.step_s,
            metrics={"done": float(policy.stage is Stage.DONE)},
            note=f"{policy.stage.value} {colour} cube",
            space=self._space,
        )

    def _watch(self, observation: Observation) -> dict[str, F64 | None]:
        """TCP pose (4, 4), at the time of each image, of the arm that carries the camera; of the
        giver for a fixed camera.

        Raises:
            UngroundedError: an image cannot be used, see `FrameWatch.check`.
        """
        giver, taker = self._options.giver, self._options.taker
        for name in (giver, taker):
            history = self._histories.setdefault(name, PoseHistory())
            history.add(observation.arms[name].ee_pose)
        newest_ns = max(frame.stamp_ns for frame in observation.frames.values())
        is_approaching = self._policy.stage is Stage.PICK and (
            self._policy.pick.episode.phase in (Phase.APPROACH, Phase.DESCEND)
        )
        places: dict[str, F64 | None] = {}
        for role, frame in observation.frames.items():
            carrier = None if frame.calibration is None else frame.calibration.arm
            if carrier == "":
                carrier = next(iter(observation.arms))
            # a fixed camera sees both arms move
            for name in (giver, taker) if carrier is None else (carrier,):
                if name not in self._histories:
                    continue  # it is on an arm that is not used
                place = self._histories[name].at(frame.stamp_ns)
                places.setdefault(role, place)
                self._watches.setdefault((role, name), FrameWatch()).check(
                    frame,
                    observation.arms[name].ee_pose,
                    place,
                    newest_ns=newest_ns,
                    must_change=carrier is None or (name == giver and is_approaching),
                )
            places.setdefault(role, None)
        return places

    def _state(self, observation: Observation, arm: str) -> ArmState:
        """State of an arm, present and finite."""
        state = observation.arms.get(arm)
        if state is None or state.gripper_open is None:
            raise InvalidInputError(
                f"The observation has no pose and opening of the arm {arm!r}.",
                hint="Is control running?",
                path="arms",
            )
        pose = state.ee_pose
        values = np.concatenate([pose.position_m, pose.quaternion_xyzw, [state.gripper_open]])
        if not np.isfinite(values).all():
            raise UnsafeError(f"The state of arm {arm!r} is not finite: {values.tolist()}.")
        return state
