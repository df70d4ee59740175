"""Named postures, gestures and places, of the configuration and of the robot."""

from __future__ import annotations

import math
from collections.abc import Mapping

from rn_standard.tasks.options import GestureOptions, PlaceOptions, PostureOptions, TasksSections
from rn_standard.tasks.run_task import profile_of
from roboneuron import Host, InvalidInputError

HOME = "home"
"""Name of the robot's own safe posture, unless configured otherwise."""


class Places:
    """Named postures, gestures and places of move_to."""

    def __init__(self, host: Host, options: TasksSections) -> None:
        self._host = host
        self._options = options

    def postures(self) -> dict[str, PostureOptions]:
        """Configured postures, and the robot's own home."""
        profile = profile_of(self._host)
        own: dict[str, PostureOptions] = {}
        if profile is not None and profile.home_rad is not None:
            joints = dict(zip(profile.arm_joints, profile.home_rad.tolist(), strict=True))
            own[HOME] = PostureOptions(joints=joints, summary="the robot's own safe posture")
        return own | self._options.postures

    def gestures(self) -> dict[str, GestureOptions]:
        """Configured gestures, and the robot's own."""
        profile = profile_of(self._host)
        own = {} if profile is None else profile.gestures
        return {
            name: GestureOptions(steps=tuple(map(dict, steps))) for name, steps in own.items()
        } | self._options.gestures

    def motions(self) -> dict[str, tuple[str, list[dict[str, float]]]]:
        """Kind and steps, positions by joint, of each posture and gesture."""
        gestures = {
            name: ("gesture", list(gesture.steps) * gesture.times)
            for name, gesture in self.gestures().items()
        }
        return gestures | {
            name: ("posture", [posture.joints]) for name, posture in self.postures().items()
        }

    def places(self) -> Mapping[str, PlaceOptions]:
        """Configured places."""
        return self._options.places

    def choices(self) -> dict[str, str]:
        """Summary by name."""
        named: dict[str, PostureOptions | GestureOptions | PlaceOptions] = {
            **self.postures(),
            **self.gestures(),
            **self.places(),
        }
        return {name: one.summary for name, one in named.items()}


def check_places(options: TasksSections) -> None:
    """Refuse ambiguous names, and orientations of zero length.

    Raises:
        InvalidInputError: names the entry.
    """
    kinds: dict[str, Mapping[str, object]] = {
        "posture": options.postures,
        "gesture": options.gestures,
        "place": options.places,
    }
    seen: dict[str, str] = {}
    for kind, names in kinds.items():
        for name in names:
            if name in seen:
                raise InvalidInputError(f"{name!r} is a {seen[name]} and a {kind}.")
            seen[name] = kind
    for name in seen.keys() & {"hold", "stop"}:
        raise InvalidInputError(f"{name!r} cannot be a name: run_task uses it for on_end.")
    for name, place in options.places.items():
        if (
            place.quaternion_xyzw is not None
            and not 0.5 < math.dist((0, 0, 0, 0), place.quaternion_xyzw) < 2.0
        ):
            raise InvalidInputError(f"The quaternion of the place {name!r} is not of unit length.")
