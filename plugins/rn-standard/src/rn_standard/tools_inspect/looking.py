"""Tools look and locate: what stands where, and the place that a pixel shows."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Annotated

import numpy as np
from pydantic import Field

from rn_standard.sight.locator import LocatedObject
from rn_standard.sight.marks import (
    CellLook,
    find_object,
    marked,
    name_of,
    pixels_of,
    scale_of,
    shown,
)
from rn_standard.sight.pointing import place_at
from rn_standard.tools_arm.grip import Grip
from roboneuron import (
    Arguments,
    CallContext,
    Frame,
    Host,
    InvalidInputError,
    NotReadyError,
    Pose,
    Reply,
    Result,
    RobotProfile,
    Tool,
    foreign,
    matrix_from_quaternion,
)
from roboneuron.feature import ExposedEndpoint

_HELD_M = 0.06
"""Distance from the TCP within which an object is the one that the hand holds."""
LookNow = Callable[[str], CellLook]
"""Takes a look for a client, by its name. Raises RoboNeuronError."""
LastLook = Callable[[str], "CellLook | None"]
"""The last look of a client."""


class LookArguments(Arguments):
    """Arguments of look."""

    pictures: bool = Field(default=True, description="false: only the list.")


class SeenObject(Result):
    """An object, in the base frame."""

    mark: int
    name: str
    position_m: list[float]
    yaw_deg: float | None
    symmetry_deg: float
    size_m: list[float]
    uncertainty_m: float
    cameras: list[str]
    age_s: float
    notes: list[str]


class Hand(Result):
    """A hand, in the base frame."""

    arm: str
    holding: bool | None
    holds: str
    position_m: list[float]
    yaw_deg: float | None


class ShownPicture(Result):
    """A picture that accompanies the answer; `marks_px` are column and row of each mark."""

    camera: str
    width_px: int
    height_px: int
    age_s: float
    marks_px: dict[str, list[int]]


class Looked(Result):
    """What the cameras show; the files are in the order of `pictures`."""

    robot: str
    objects: list[SeenObject]
    hands: list[Hand]
    pictures: list[ShownPicture]
    problems: dict[str, str] = Field(description="camera -> why it tells no places")
    took_s: float


class LocateArguments(Arguments):
    """Arguments of locate."""

    camera: str = Field(default="", description="Of the last look; for a pixel.")
    pixel: Annotated[list[float], Field(min_length=2, max_length=2)] | None = Field(
        default=None, description="Column, row in its picture."
    )
    mark: int | None = Field(default=None, ge=1, description="Instead of a pixel.")


class LocatedPlace(Result):
    """A place in the base frame."""

    position_m: list[float]
    uncertainty_m: float
    surface: str = Field(description="object (then its top for a mark), depth or table")
    mark: int | None
    name: str
    age_s: float = Field(description="of the picture")


def yaw_deg(pose: Pose) -> float:
    """Direction of the hand's x axis about the vertical [deg]."""
    x_axis = matrix_from_quaternion(pose.quaternion_xyzw)[:, 0]
    return round(float(np.degrees(np.arctan2(x_axis[1], x_axis[0]))), 1)


def seen_object(one: LocatedObject, mark: int, now_ns: int) -> SeenObject:
    """An object as agents are told it."""
    notes = []
    if not one.is_whole:
        notes.append("partly hidden")
    if one.is_height_assumed:
        notes.append("one camera: height assumed")
    yaw = one.yaw_rad
    return SeenObject(
        mark=mark,
        name=name_of(one),
        position_m=[round(value, 4) for value in one.position_m.tolist()],
        yaw_deg=None if yaw is None else round(float(np.degrees(yaw)), 1),
        symmetry_deg=round(float(np.degrees(one.symmetry_rad)), 1),
        size_m=[round(value, 4) for value in one.size_m.tolist()],
        uncertainty_m=round(one.uncertainty_m, 4),
        cameras=[foreign.printable(camera, 40) for camera in one.cameras],
        age_s=round(max(0.0, (now_ns - one.seen_at_ns) / 1e9), 2),
        notes=notes,
    )


def hands_of(
    host: Host, exposed: ExposedEndpoint | None, profile: RobotProfile | None, look: CellLook
) -> list[Hand]:
    """Each hand, and which object it holds; blocks until fingers rest."""
    runs = host.modules.view("robot").phase == "running"
    hands = []
    for arm in () if profile is None else profile.each_arm:
        pose = look.view.tcps.get(arm.name)
        grip = None if exposed is None else Grip(host, host.gate, exposed, arm.name)
        holding = grip.holding() if grip is not None and runs else None
        hands.append(
            Hand(
                arm=arm.name,
                holding=holding,
                holds=held_name(look, pose) if holding else "",
                position_m=[] if pose is None else np.round(pose.position_m, 4).tolist(),
                yaw_deg=None if pose is None else yaw_deg(pose),
            )
        )
    return hands


def held_name(look: CellLook, pose: Pose | None) -> str:
    """Name of the object between the fingers; empty if none is seen there."""
    near = [
        (float(np.linalg.norm(one.position_m - pose.position_m)), name_of(one))
        for one in look.objects
        if pose is not None
    ]
    distance_m, name = min(near, default=(np.inf, ""))
    return name if distance_m < _HELD_M else ""


def _shown(frame: Frame, marks: Mapping[int, tuple[int, int]], now_ns: int) -> ShownPicture:
    height, width = shown(frame).shape[:2]
    return ShownPicture(
        camera=frame.camera,
        width_px=width,
        height_px=height,
        age_s=round(max(0.0, (now_ns - frame.stamp_ns) / 1e9), 2),
        marks_px={str(mark): list(place) for mark, place in marks.items()},
    )


def look_tool(
    host: Host, look_now: LookNow, arm_of: Callable[[], ExposedEndpoint | None]
) -> Tool[LookArguments]:
    """look."""

    def work(arguments: LookArguments, who: str) -> Reply:
        began_s = time.monotonic()
        look = look_now(who)
        exposed = arm_of()
        profile = None if exposed is None else exposed.profile
        pixels = pixels_of(look)
        now_ns = look.view.taken_ns
        objects = [seen_object(one, mark, now_ns) for mark, one in enumerate(look.objects, 1)]
        problems = {foreign.printable(k, 40): text for k, text in look.view.problems.items()}
        if look.failure:
            problems["locator"] = look.failure
        told = [_shown(frame, pixels.get(frame.camera, {}), now_ns) for frame in look.view.frames]
        files = [marked(frame, pixels.get(frame.camera, {})) for frame in look.view.frames]
        return Reply(
            result=Looked(
                robot=host.config.robot.name,
                objects=objects,
                hands=hands_of(host, exposed, profile, look),
                pictures=told,
                problems=problems,
                took_s=round(time.monotonic() - began_s, 3),
            ),
            pictures=tuple(files) if arguments.pictures else (),
        )

    async def look(arguments: LookArguments, context: CallContext) -> Reply:
        return await context.run(lambda _: work(arguments, context.who))

    return Tool(
        name="look",
        title="Look at the scene",
        description="Objects with positions, what the hand holds, and a picture of each camera "
        "with numbered marks. Needs start_perception.",
        arguments=LookArguments,
        result=Looked,
        handler=look,
        read_only=True,
        idempotent=True,
        open_world=True,
    )


def locate_tool(
    look_now: LookNow, last_look: LastLook, table_m: Callable[[], float]
) -> Tool[LocateArguments]:
    """locate."""

    def work(arguments: LocateArguments, who: str) -> LocatedPlace:
        if (arguments.pixel is None) == (arguments.mark is None):
            raise InvalidInputError("Give a pixel with its camera, or a mark.", path="pixel")
        look = last_look(who) or look_now(who)
        if arguments.mark is not None:
            return _of_mark(look, arguments.mark)
        assert arguments.pixel is not None
        return _of_pixel(look, arguments.camera, arguments.pixel, table_m())

    async def locate(arguments: LocateArguments, context: CallContext) -> LocatedPlace:
        return await context.run(lambda _: work(arguments, context.who))

    return Tool(
        name="locate",
        title="Find the place of a pixel",
        description="The place on the object or table that a pixel of your last look shows.",
        arguments=LocateArguments,
        result=LocatedPlace,
        handler=locate,
        read_only=True,
        idempotent=True,
    )


def _of_mark(look: CellLook, mark: int) -> LocatedPlace:
    one = find_object(look.objects, mark)
    top = one.position_m + np.array([0.0, 0.0, one.size_m[2] / 2])
    return LocatedPlace(
        position_m=[round(value, 4) for value in top.tolist()],
        uncertainty_m=round(one.uncertainty_m, 4),
        surface="object",
        mark=mark,
        name=name_of(one),
        age_s=_age_s(one.seen_at_ns),
    )


def _of_pixel(look: CellLook, camera: str, pixel: list[float], table_m: float) -> LocatedPlace:
    """Raises InvalidInputError, NotReadyError, RefusedError."""
    frames = {frame.camera: frame for frame in look.view.frames}
    known = ", ".join({**frames, **look.view.problems})
    if camera not in frames and camera not in look.view.problems:
        raise InvalidInputError(
            f"There is no camera {foreign.quoted(camera, 40)}.",
            hint=f"Cameras: {known}.",
            path="camera",
        )
    if camera in look.view.problems:
        raise NotReadyError(f"Camera {camera!r} tells no places. {look.view.problems[camera]}")
    image = next(one for one in look.view.images if one.frame.camera == camera)
    height, width = shown(image.frame).shape[:2]
    if not (0 <= pixel[0] < width and 0 <= pixel[1] < height):
        raise InvalidInputError(
            f"The pixel {pixel} is outside the picture of {width} x {height}.", path="pixel"
        )
    place = place_at(image, np.array(pixel) * scale_of(image.frame), look.objects, table_m)
    number = place.number
    return LocatedPlace(
        position_m=[round(value, 4) for value in place.position_m.tolist()],
        uncertainty_m=round(place.uncertainty_m, 4),
        surface=place.surface,
        mark=None if number is None else number + 1,
        name="" if number is None else name_of(look.objects[number]),
        age_s=_age_s(image.frame.stamp_ns),
    )


def _age_s(stamp_ns: int) -> float:
    return round(max(0.0, (time.time_ns() - stamp_ns) / 1e9), 2)
