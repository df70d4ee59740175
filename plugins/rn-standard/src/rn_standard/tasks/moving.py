"""Tool move_to: moves to named postures and places of the robot, with the tools of the arm."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rn_standard.tasks.options import PlaceOptions, PostureOptions, TasksSections
from rn_standard.tasks.run_task import profile_of
from rn_standard.tools_arm.grip import check_gripper
from roboneuron import (
    Arguments,
    ArmProfile,
    CallContext,
    Host,
    InvalidInputError,
    NotReadyError,
    RefusedError,
    Result,
    StateError,
    Tool,
    matrix_from_quaternion,
    rotvec_from_matrix,
)

HOME = "home"
"""Name of the robot's own safe posture, unless configured otherwise."""
_MOST_M, _MOST_RAD = 0.3, 1.2
"""Largest translation and rotation of one straight part of a move to a place."""
_PARTS = 32
_THERE_M, _THERE_RAD = 0.004, 0.02
F64 = NDArray[np.float64]
PoseNow = Callable[[str], tuple[F64, F64]]
"""Waits for the measured TCP pose of an arm, "" for the only one; returns position (3,) [m] and
rotation (3, 3) in the base frame.
"""

CallArm = Callable[[str, Mapping[str, object], CallContext], Awaitable[dict[str, Any]]]
"""Calls a tool of the arm by its name; returns what it answers. Raises as the tool."""


class MoveToArguments(Arguments):
    """Arguments of move_to."""

    name: str = Field(description="Where to.")


class MovedTo(Result):
    """The arm was measured at the target."""

    name: str
    kind: str = Field(description="posture or place")
    error: float = Field(
        description="largest distance from a joint's target [rad or m], or of the TCP [m]"
    )
    took_s: float


class Places:
    """Named postures and places of move_to."""

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

    def places(self) -> Mapping[str, PlaceOptions]:
        """Configured places."""
        return self._options.places

    def choices(self) -> dict[str, str]:
        """Summary by name."""
        postures = {name: posture.summary for name, posture in self.postures().items()}
        return postures | {name: place.summary for name, place in self.places().items()}


class Mover:
    """Moves to a posture or place by calling move_joints or move_ee on behalf of the same
    client.
    """

    def __init__(
        self, host: Host, places: Places, pose_now: PoseNow, call: CallArm | None = None
    ) -> None:
        """Args:
        host: of the feature.
        places: those it knows.
        pose_now: tells where the arm is.
        call: what moves the arm instead of the tools.
        """
        self._host = host
        self._places = places
        self._pose_now = pose_now
        self._call = call or self._call_tool

    async def __call__(self, name: str, context: CallContext) -> MovedTo:
        """Move to a named target.

        Raises:
            InvalidInputError: no such name.
            NotReadyError: the tool that moves the arm is missing.
            RoboNeuronError: as move_joints and move_ee.
        """
        postures, places = self._places.postures(), self._places.places()
        if name in postures:
            answer = await self._call(
                "move_joints", {"positions": dict(postures[name].joints)}, context
            )
            return MovedTo(
                name=name, kind="posture", error=answer["error"], took_s=answer["duration_s"]
            )
        if name in places:
            return await self._to_place(name, places[name], context)
        known = (
            ", ".join({**postures, **places})
            or "none; a person adds them as [postures.<name>] or [places.<name>]"
        )
        raise InvalidInputError(
            f"There is no posture or place {name[:64]!r}.", hint=f"There are: {known}.", path="name"
        )

    async def _to_place(self, name: str, place: PlaceOptions, context: CallContext) -> MovedTo:
        """Move along straight parts, each computed from the pose measured at its start."""
        took_s, stops = 0.0, self._host.loop.starts.arm_stops
        arms = [arm.name for arm in _arms(self._host)]
        if place.arm not in (arms or [""]):
            told = f"names the arm {place.arm!r}" if place.arm else "names no arm"
            known = (
                f"the arms are {', '.join(map(repr, arms))}" if arms else "the only one has none"
            )
            raise InvalidInputError(
                f"The place {name!r} {told}; {known}.",
                hint=f"Set arm in [places.{name}].",
            )
        arm: dict[str, object] = {"arm": place.arm} if place.arm else {}
        gripper = {} if place.gripper_open is None else {"gripper_open": place.gripper_open}
        if gripper:
            check_gripper(self._host, profile_of(self._host), place.arm)
        for _ in range(_PARTS):
            position, rotation = await context.run(lambda _: self._pose_now(place.arm))
            if self._host.loop.starts.arm_stops != stops:
                raise StateError(
                    f"It was stopped on its way to {name!r}: {self._host.loop.starts.reason}."
                )
            delta, turn = self._left(place, position, rotation)
            far_m, far_rad = float(np.linalg.norm(delta)), float(np.linalg.norm(turn))
            share = min(1.0, _MOST_M / max(far_m, 1e-9), _MOST_RAD / max(far_rad, 1e-9))
            if far_m < _THERE_M and far_rad < _THERE_RAD:
                if gripper:
                    took_s += (await self._call("move_ee", {**arm, **gripper}, context))[
                        "duration_s"
                    ]
                return MovedTo(
                    name=name, kind="place", error=round(far_m, 5), took_s=round(took_s, 3)
                )
            axes = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")
            part = dict(zip(axes, (share * np.concatenate([delta, turn])).tolist(), strict=True))
            took_s += (await self._call("move_ee", {**arm, **part}, context))["duration_s"]
        raise NotReadyError(f"The TCP does not reach {name!r}; it is {far_m * 1000:.0f} mm away.")

    def _left(self, place: PlaceOptions, position: F64, rotation: F64) -> tuple[F64, F64]:
        delta: F64 = np.array(place.position_m) - position
        if place.quaternion_xyzw is None:
            return delta, np.zeros(3)
        wanted = np.array(place.quaternion_xyzw)
        return delta, rotvec_from_matrix(
            matrix_from_quaternion(wanted / np.linalg.norm(wanted)) @ rotation.T
        )

    async def _call_tool(
        self, tool_name: str, arguments: Mapping[str, object], context: CallContext
    ) -> dict[str, Any]:
        tool = self._host.tools.get(tool_name)
        if tool is None:
            raise NotReadyError(
                f"There is no tool {tool_name} now.", hint="It comes with rn-tools-arm and an arm."
            )
        answer = await tool.call(arguments, context)
        if not answer.structured.get("allowed", True) or answer.structured.get("simulated"):
            raise RefusedError(
                f"The arm was not moved: {answer.structured.get('reason') or 'only simulated'}.",
                rule="simulate",
            )
        return dict(answer.structured)


def _arms(host: Host) -> tuple[ArmProfile, ...]:
    """The arms of a robot with several."""
    profile = profile_of(host)
    return () if profile is None else profile.arms


def check_places(options: TasksSections) -> None:
    """Refuse ambiguous names, and orientations of zero length.

    Raises:
        InvalidInputError: names the entry.
    """
    for name in {*options.postures} & {*options.places}:
        raise InvalidInputError(f"{name!r} is a posture and a place.")
    for name in {*options.postures, *options.places} & {"hold", "stop"}:
        raise InvalidInputError(f"{name!r} cannot be a name: run_task uses it for on_end.")
    for name, place in options.places.items():
        if (
            place.quaternion_xyzw is not None
            and not 0.5 < math.dist((0, 0, 0, 0), place.quaternion_xyzw) < 2.0
        ):
            raise InvalidInputError(f"The quaternion of the place {name!r} is not of unit length.")


def move_to_subject(places: Places, arguments: MoveToArguments) -> tuple[str, str] | None:
    """What a person is asked to approve, see `Approval`; None for an unknown name."""
    return ("move to", arguments.name) if arguments.name in places.choices() else None


def move_to_tool(mover: Mover, places: Places) -> Tool[MoveToArguments]:
    """move_to."""

    async def handler(arguments: MoveToArguments, context: CallContext) -> MovedTo:
        return await mover(arguments.name, context)

    return Tool(
        name="move_to",
        title="Move to a named posture or place",
        description="Move the arm to a named posture, or in straight lines to a named place "
        "(needs start_control). "
        "Refused while a policy has an instruction. Returns when it is measured there.",
        arguments=MoveToArguments,
        result=MovedTo,
        handler=handler,
        simulated_by=frozenset({"twin"}),
        open_world=True,
        choices={"name": places.choices},
    )
