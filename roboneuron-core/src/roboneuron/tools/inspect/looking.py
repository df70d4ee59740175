"""Tools look and locate: what stands where, and the place that a pixel shows."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from pydantic import Field

from roboneuron import foreign
from roboneuron.contract import Frame, Pose, RobotProfile
from roboneuron.contract.locator import MOST_LABEL, MOST_LABELS, LocatedObject
from roboneuron.contract.rotation import matrix_from_quaternion
from roboneuron.errors import InvalidInputError, NotReadyError
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint
from roboneuron.server.tool import Arguments, CallContext, Reply, Result, Tool
from roboneuron.sight.cell_view import CellView
from roboneuron.sight.marks import (
    CellLook,
    find_object,
    look_pictures,
    name_of,
    pixels_of,
    scale_of,
    shown,
)
from roboneuron.sight.pointing import place_at
from roboneuron.sight.segmentation import tint_of
from roboneuron.sight.sightlines import HandSight
from roboneuron.tools.arm.grip import Grip


class LookNow(Protocol):
    """Takes a look for a client, by its name. Raises RoboNeuronError."""

    def __call__(self, who: str, *, labels: Sequence[str] = ()) -> CellLook:
        """See `Looker.look`."""


TINTED = (
    "The light on its picture is coloured: objects may be missed, and colours named wrongly. "
    "Use white light, or the white balance of the camera."
)
LastLook = Callable[[str], "CellLook | None"]
"""The last look of a client."""


class LookArguments(Arguments):
    """Arguments of look."""

    pictures: bool = Field(default=True, description="false: list only.")
    labels: list[Annotated[str, Field(max_length=MOST_LABEL)]] = Field(
        default=[], max_length=MOST_LABELS, description="What to look for."
    )


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
    problems: dict[str, str] = Field(description="camera -> what is wrong with its picture")
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


def seen_object(look: CellLook, mark: int) -> SeenObject:
    """An object of a look as agents are told it."""
    one, now_ns = look.objects[mark - 1], look.view.taken_ns
    notes = []
    if one in look.hidden:
        notes.append("hidden or seen badly now: where it was last seen well")
    if one in look.held.values():
        notes.append("in the hand")
    elif not one.is_whole:
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


@runtime_checkable
class KnowsGrasps(Protocol):
    """A feature that knows what a hand has grasped."""

    def held_at(self, arm: str, pose: Pose) -> LocatedObject | None:
        """What the hand of an arm holds, with its TCP at a pose; None if pick did not grasp it."""


def hands_in(host: Host, exposed: ExposedEndpoint | None, view: CellView) -> dict[str, HandSight]:
    """Each measured hand of the present robot, by its arm; blocks until fingers rest."""
    profile = None if exposed is None else exposed.profile
    if exposed is None or profile is None:
        return {}
    runs = host.modules.view("robot").phase == "running"
    knowing = [one for one in host.features.loaded.values() if isinstance(one, KnowsGrasps)]
    hands = {}
    for arm in profile.each_arm:
        pose = view.tcps.get(arm.name)
        if pose is None:
            continue
        holding = Grip(host, host.gate, exposed, arm.name).holding() if runs else None
        held = [feature.held_at(arm.name, pose) for feature in knowing] if holding else []
        hands[arm.name] = HandSight(
            position_m=np.array(pose.position_m),
            holding=holding,
            known=next((one for one in held if one is not None), None),
        )
    return hands


def hands_of(profile: RobotProfile | None, look: CellLook) -> list[Hand]:
    """Each hand, and which object it holds."""
    hands = []
    for arm in () if profile is None else profile.each_arm:
        pose, hand = look.view.tcps.get(arm.name), look.hands.get(arm.name)
        held = look.held.get(arm.name, None if hand is None else hand.known)
        hands.append(
            Hand(
                arm=arm.name,
                holding=None if hand is None else hand.holding,
                holds="" if held is None else name_of(held),
                position_m=[] if pose is None else np.round(pose.position_m, 4).tolist(),
                yaw_deg=None if pose is None else yaw_deg(pose),
            )
        )
    return hands


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
        look = look_now(who, labels=arguments.labels)
        exposed = arm_of()
        profile = None if exposed is None else exposed.profile
        pixels = pixels_of(look)
        now_ns = look.view.taken_ns
        objects = [seen_object(look, mark) for mark in range(1, len(look.objects) + 1)]
        problems = {foreign.printable(k, 40): text for k, text in look.view.problems.items()}
        for frame in look.view.frames:
            if tint_of(frame.image) is not None:
                problems.setdefault(foreign.printable(frame.camera, 40), TINTED)
        if look.failure:
            problems["locator"] = look.failure
        told = [_shown(frame, pixels.get(frame.camera, {}), now_ns) for frame in look.view.frames]
        return Reply(
            result=Looked(
                robot=host.config.robot.name,
                objects=objects,
                hands=hands_of(profile, look),
                pictures=told,
                problems=problems,
                took_s=round(time.monotonic() - began_s, 3),
            ),
            pictures=tuple(look_pictures(look)) if arguments.pictures else (),
        )

    async def look(arguments: LookArguments, context: CallContext) -> Reply:
        return await context.run(lambda _: work(arguments, context.who))

    return Tool(
        name="look",
        title="Look at the scene",
        description="Objects with positions, what hands hold, and pictures with numbered "
        "marks. Needs start_perception.",
        arguments=LookArguments,
        result=Looked,
        handler=look,
        read_only=True,
        idempotent=True,
        open_world=True,
    )


def locate_tool(look_now: LookNow, last_look: LastLook) -> Tool[LocateArguments]:
    """locate."""

    def work(arguments: LocateArguments, who: str) -> LocatedPlace:
        if (arguments.pixel is None) == (arguments.mark is None):
            raise InvalidInputError("Give a pixel with its camera, or a mark.", path="pixel")
        look = last_look(who) or look_now(who)
        if arguments.mark is not None:
            return _of_mark(look, arguments.mark)
        assert arguments.pixel is not None
        return _of_pixel(look, arguments.camera, arguments.pixel)

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


def _of_pixel(look: CellLook, camera: str, pixel: list[float]) -> LocatedPlace:
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
    place = place_at(image, np.array(pixel) * scale_of(image.frame), look.objects)
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
