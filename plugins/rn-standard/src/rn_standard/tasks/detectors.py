"""Monitors of this package: a coloured object was lifted, is in a region, or the scene has
changed.
"""

from __future__ import annotations

from itertools import combinations
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from rn_standard.tasks.monitor import Score
from roboneuron import F64, Observation
from roboneuron.sight.rays import rays_of

Colour = Literal["red", "orange", "yellow", "green", "blue", "purple"]
_Point = Annotated[tuple[float, float, float], Field(strict=False)]
_BESIDE_M = 0.03
"""Largest distance between the rays of two views of the same object."""
_COARSE_M = 0.06
"""The same if one view is partial, as that of a wrist camera on a held object."""
_FADE_M = 0.05
_STACKED_M, _OVER_M = (0.02, 0.12), 0.03
"""Range of the height between the centres of objects that lie on each other, and how far the upper
one may be beside.
"""
_HELD_M, _HOLDS = 0.06, (0.05, 0.9)
"""Distance from the TCP, and range of openings, within which an object counts as held."""


class _Options(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def locate(observation: Observation, colour: str) -> F64 | str:
    """Centre (3,) of the coloured object in the base frame [m] from two views, or the reason why it
    is unknown.
    """
    rays = rays_of(observation, colour)
    if len(rays) < 2 or all(ray.is_coarse for ray in rays.values()):
        seen = " and ".join(
            f"{role}{' (cut)' if ray.is_coarse else ''}" for role, ray in rays.items()
        )
        who = f"only {seen} sees it" if rays else "no calibrated camera sees it"
        return f"{who}, two views are needed to tell where the {colour} object is"
    pairs = [
        pair for pair in combinations(rays.values(), 2) if not all(ray.is_coarse for ray in pair)
    ]
    found = [
        (*meeting, any(r.is_coarse for r in pair))
        for pair in pairs
        if (meeting := pair[0].meeting(pair[1])) is not None
    ]
    if not found:
        return "the views are too alike to tell a place"
    place, apart_m, is_coarse = min(found, key=lambda meeting: meeting[1])
    if apart_m > (_COARSE_M if is_coarse else _BESIDE_M):
        return f"the views disagree by {apart_m * 100:.0f} cm about the {colour} object"
    return place


class LiftedOptions(_Options):
    """Options of the monitor `colour-lifted`."""

    colour: Colour = Field(default="red", description="of the object; no other may have it")
    height_m: float = Field(
        default=0.10, gt=0, le=2, description="how far above where it lay it must be [m]"
    )


class ColourLifted:
    """Scores the lifting of an object of a colour: its height from two views, relative to its
    initial height.

    The initial height is that of the first observation at rest; a lift of 0.9 of `height_m` scores
    0.9. An object that is already held is not at rest: then the resting height observed in the
    previous task counts.
    """

    def __init__(self, config: LiftedOptions | None) -> None:
        self._options = config or LiftedOptions()
        self._rest_m: float | None = None
        self._is_of_before = False

    def follow(self, previous: ColourLifted) -> None:
        """See `RememberingMonitor.follow`."""
        self._rest_m, self._is_of_before = previous._rest_m, True

    def reset(self, observation: Observation) -> None:
        """Store its resting height; the height from an earlier observation is kept if it is now
        hidden or held.
        """
        place = locate(observation, self._options.colour)
        if isinstance(place, str) or _is_held(place, observation):
            return
        if self._rest_m is None or self._is_of_before or place[2] < self._rest_m:
            self._rest_m, self._is_of_before = float(place[2]), False

    def score(self, observation: Observation) -> Score:
        """Lifted fraction of the height."""
        options = self._options
        place = locate(observation, options.colour)
        if isinstance(place, str):
            return Score(value=None, reason=place)
        if self._rest_m is None:
            held = "the hand is around it already, and " if _is_held(place, observation) else ""
            return Score(
                value=None,
                reason=f"{held}it was not seen where the {options.colour} object lay before",
            )
        lifted_m = float(place[2]) - self._rest_m
        value = min(1.0, max(0.0, lifted_m / options.height_m))
        return Score(
            value=value,
            reason=f"the {options.colour} object is {lifted_m * 100:.0f} cm above where it lay",
        )


def _is_held(place: F64, observation: Observation) -> bool:
    """True if an object at that place is between fingers: near a TCP whose gripper is neither open
    nor closed.
    """
    hands = [(observation.ee_pose, observation.gripper_open)]
    hands += [(arm.ee_pose, arm.gripper_open) for arm in observation.arms.values()]
    for pose, opening in hands:
        if pose is None or opening is None or not _HOLDS[0] < opening < _HOLDS[1]:
            continue
        if np.linalg.norm(place - pose.position_m) < _HELD_M:
            return True
    return False


class RegionOptions(_Options):
    """Options of the monitor `object-in-region`."""

    colour: Colour = Field(default="red", description="of the object; no other may have it")
    lower_m: _Point = Field(
        default=(0.3, -0.3, 0.0), description="corner of the box in the base frame"
    )
    upper_m: _Point = Field(default=(0.7, 0.3, 0.1), description="opposite corner")
    rests_at_m: float | None = Field(
        default=None,
        description="height of its centre when it rests; then one camera beside the robot suffices",
    )


class ObjectInRegion:
    """Scores the position of an object of a colour in a box; outside, the score falls to 0 within 5
    cm.
    """

    def __init__(self, config: RegionOptions | None) -> None:
        self._options = config or RegionOptions()

    def reset(self, observation: Observation) -> None:
        """Nothing to store."""

    def score(self, observation: Observation) -> Score:
        """1 inside."""
        options = self._options
        place = self._place(observation)
        if isinstance(place, str):
            return Score(value=None, reason=place)
        outside = np.maximum(
            np.maximum(options.lower_m - place, place - np.array(options.upper_m)), 0.0
        )
        distance_m = float(np.linalg.norm(outside))
        told = ", ".join(f"{value:.2f}" for value in place)
        return Score(
            value=max(0.0, 1.0 - distance_m / _FADE_M),
            reason=f"the {options.colour} object is at [{told}] m",
        )

    def _place(self, observation: Observation) -> F64 | str:
        options = self._options
        if options.rests_at_m is None:
            return locate(observation, options.colour)
        rays = rays_of(observation, options.colour)
        points = [
            point
            for ray in rays.values()
            if not ray.is_coarse and (point := ray.at_height(options.rests_at_m)) is not None
        ]
        if not points:
            return f"no calibrated camera sees the {options.colour} object whole"
        if any(np.linalg.norm(point - points[0]) > 2 * _BESIDE_M for point in points):
            return (
                f"the views disagree about the {options.colour} object: it may not rest at "
                "that height"
            )
        return points[0]


class OnOptions(_Options):
    """Options of the monitor `object-on`."""

    colour: Colour = Field(default="red", description="of the upper object; no other may have it")
    on: Colour = Field(default="blue", description="of the lower object; no other may have it")


class ObjectOn:
    """Scores that an object of a colour lies on one of another colour: from two views, it is above
    and let go; beside or too high, the score falls to 0 within 5 cm.
    """

    def __init__(self, config: OnOptions | None) -> None:
        self._options = config or OnOptions()

    def reset(self, observation: Observation) -> None:
        """Nothing to store."""

    def score(self, observation: Observation) -> Score:
        """1 on it."""
        colour, on = self._options.colour, self._options.on
        upper, lower = locate(observation, colour), locate(observation, on)
        if isinstance(upper, str):
            return Score(value=None, reason=upper)
        if isinstance(lower, str):
            return Score(value=None, reason=lower)
        if _is_held(upper, observation):
            return Score(value=0.0, reason=f"the gripper holds the {colour} object")
        beside_m = float(np.linalg.norm(upper[:2] - lower[:2]))
        above_m = float(upper[2] - lower[2])
        lowest_m, highest_m = _STACKED_M
        away_m = max(0.0, beside_m - _OVER_M) + max(0.0, lowest_m - above_m, above_m - highest_m)
        return Score(
            value=max(0.0, 1.0 - away_m / _FADE_M),
            reason=f"the {colour} object is {above_m * 100:.0f} cm above the {on} one and "
            f"{beside_m * 100:.0f} cm beside it",
        )


class ChangedOptions(_Options):
    """Options of the monitor `scene-changed`."""

    camera: str = Field(default="primary", description="role of the camera")
    share: float = Field(
        default=0.003, gt=0, le=1, description="share of the image that must have changed"
    )
    level: float = Field(
        default=0.12, gt=0, lt=1, description="change of a pixel that counts, 0 .. 1"
    )
    arm_back_m: float = Field(
        default=0.03,
        gt=0,
        le=1,
        description="the TCP must be so near to where it was before: an arm is a change too",
    )


class SceneChanged:
    """Scores the change of the image since the start of the attempt, with the arm back in place."""

    def __init__(self, config: ChangedOptions | None) -> None:
        self._options = config or ChangedOptions()
        self._before: tuple[NDArray[np.uint8], F64 | None] | None = None

    def reset(self, observation: Observation) -> None:
        """Store the image and the pose of the arm."""
        frame, pose = observation.frames.get(self._options.camera), observation.ee_pose
        self._before = (
            None
            if frame is None
            else (frame.image.copy(), None if pose is None else pose.position_m)
        )

    def score(self, observation: Observation) -> Score:
        """Number of changed pixels, as a fraction of `share`."""
        options, frame, pose = (
            self._options,
            observation.frames.get(self._options.camera),
            observation.ee_pose,
        )
        if frame is None or self._before is None or frame.image.shape != self._before[0].shape:
            return Score(
                value=None, reason=f"there is no image of {options.camera!r} from before and now"
            )
        image, place = self._before
        if place is not None and (
            pose is None or np.linalg.norm(pose.position_m - place) > options.arm_back_m
        ):
            return Score(
                value=None, reason="the arm is elsewhere than before, and hides what it wants"
            )
        changed = np.abs(frame.image.astype(np.int16) - image).max(axis=2) > options.level * 255
        share = float(changed.mean())
        return Score(
            value=min(1.0, share / options.share), reason=f"{share:.1%} of the image has changed"
        )
