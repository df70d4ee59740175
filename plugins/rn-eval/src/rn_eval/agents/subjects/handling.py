"""Rules of the scripted agents that pick up, place and push cubes."""

from __future__ import annotations

import math
import re

import anyio

from rn_eval.agents.subjects.actions import end_recording, tighten
from rn_eval.agents.subjects.reading import moves_of, named_colours, number_before, place_of
from rn_eval.agents.subjects.sight import Looking, Seen, by_edge, leftmost_of
from rn_eval.agents.tasks.steps import (
    DONE,
    hold_up,
    lift_whatever_happens,
    put_whatever_happens,
    wait_until_free,
)
from roboneuron import NotReadyError

_POLICY = re.compile(r"whatever|fails")
"""Requests in which modules, and so a policy too, may fail on the way."""
_GENTLE = 0.2
_ROOM_M = 0.12
_SPARE_M = [(x, y) for y in (0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3) for x in (0.45, 0.55, 0.6, 0.4)]
"""Places to put something aside, x and y in the base frame [m]."""


def free_place(cubes: dict[str, Seen], *, half: float = 0.0) -> tuple[float, float]:
    """A place with room around it; with `half` 1 or -1 on the left or right half of the table.
    Raises NotReadyError if there is none.
    """
    for x, y in _SPARE_M:
        is_free = all(math.hypot(c.x_m - x, c.y_m - y) >= _ROOM_M for c in cubes.values())
        if is_free and (half == 0.0 or y * half >= 0.08):
            return x, y
    raise NotReadyError("No free place is seen on the table.")


async def when_free(sight: Looking, text: str) -> str:
    """Wait for another client, then pick up."""
    await wait_until_free(sight.tools)
    return await pick(sight, text)


async def take_over(sight: Looking, text: str) -> str:
    """Take the robot over, then pick up."""
    await sight.tools.must("take_over")
    return await pick(sight, text)


async def after_release(sight: Looking, text: str) -> str:
    """Wait for a person's release, then pick up."""
    while (await sight.tools.must("get_status")).data.get("emergency_stop"):
        await anyio.sleep(1.0)
    return await pick(sight, text)


async def pick(sight: Looking, text: str) -> str:
    """Pick up the cube that the sentence names by colour, by others, or by its place."""
    target = await _meant(sight, text)
    if not target:
        return "CLAIM: not done: it is not clear which cube is meant"
    if re.search(r"cm/s|further (?:left|right)", text):
        await sight.start()
        await tighten(sight.tools, text)
    if "record" in text:
        await sight.start()
        await sight.tools.must("start_recording", name="job")
    try:
        await lift(sight, target, by_policy=bool(_POLICY.search(text)))
    except NotReadyError:
        seen = await sight.cubes()
        if target in seen:
            raise
        return f"CLAIM: refused: no {target} cube is seen, only {', '.join(seen)}"
    if place := place_of(text):
        await sight.insist("move_to", position_m=[place[axis] for axis in "xyz"])
    if "home" in text:
        await sight.insist("move_to", name="home")
    if re.search(r"take a picture|through a camera", text):
        await sight.insist("look")
    return await end_recording(sight.tools) if "record" in text else DONE


async def _meant(sight: Looking, text: str) -> str:
    colours = named_colours(text)
    if owner := re.search(r"cube (?:of|that belongs to) (\w+)", text):
        return await _lifted_for(sight, owner[1])
    if "neither" in text:
        others = [colour for colour in await sight.cubes() if colour not in colours]
        return others[0] if len(others) == 1 else ""
    if "leftmost" in text or "furthest to the left" in text:
        return await leftmost_of(sight)
    if "middle one" in text or "between the other two" in text:
        cubes = await sight.cubes()
        in_order = sorted(cubes, key=lambda colour: cubes[colour].y_m)
        return in_order[len(in_order) // 2]
    return colours[0] if colours else ""


async def _lifted_for(sight: Looking, person: str) -> str:
    """The colour of the cube that was last picked up for a person, by the journal; "" for none."""
    entries = (await sight.tools.must("get_journal", kind="task")).data["entries"]
    assert isinstance(entries, list)
    for past in entries:
        words = str(past["instruction"]).lower()
        if past["outcome"] == "succeeded" and person in words.split():
            return next(iter(named_colours(words)), "")
    return ""


async def lift(sight: Looking, colour: str, *, by_policy: bool = False) -> None:
    """Pick up a cube by pick, or by a policy as often as it takes. Raises NotReadyError."""
    if by_policy:
        await lift_whatever_happens(sight.tools, colour)
        sight.held = colour
    else:
        await sight.take(colour)


async def pointed(sight: Looking, text: str) -> str:
    """Pick up what a pixel shows."""
    found = re.search(r"column (\d+), row (\d+)", text)
    assert found is not None
    pixel = [int(found[1]), int(found[2])]
    await sight.start()
    await sight.insist("look")
    place = (await sight.insist("locate", camera="front", pixel=pixel)).data["position_m"]
    await sight.insist("pick", position_m=place)
    return DONE


async def hold(sight: Looking, text: str) -> str:
    """Hold a cube up for some time."""
    colours, seconds = named_colours(text), number_before(text, "seconds")
    if not colours or seconds is None:
        return "CLAIM: not done: the sentence names no colour or no time"
    await hold_up(sight.tools, colours[0], seconds)
    return DONE


async def put(sight: Looking, text: str) -> str:
    """Put one cube somewhere, then perhaps pick up another one."""
    colours, place, tools = named_colours(text), place_of(text), sight.tools
    if re.search(r"falls|slip", text) and {"x", "y"} <= place.keys():
        await put_whatever_happens(tools, colours[0], place["x"], place["y"])
        return DONE
    if sight.held != colours[0]:
        await sight.take(colours[0])
    await sight.put(**await _where(sight, text, colours))
    if re.search(r"then (?:pick|lift)", text) and len(colours) > 1:
        await sight.take(colours[1])
    return DONE


async def _where(sight: Looking, text: str, colours: list[str]) -> dict[str, object]:
    """Arguments of place for a sentence. Raises NotReadyError."""
    place, moves, yaw_deg = place_of(text), moves_of(text), re.search(r"yaw of (-?\d+)", text)
    if {"x", "y"} <= place.keys():
        more = {"yaw_deg": float(yaw_deg[1])} if yaw_deg else {}
        return {"position_m": [place["x"], place["y"]], **more}
    if re.search(r" onto | on top of ", text):
        return {"on": await sight.words_for(colours[1])}
    if gap_cm := number_before(text, "cm between"):
        side = "+y" if "left side" in text else "-y"
        beside = await sight.words_for(colours[1])
        return {"beside": beside, "side": side, "gap_m": gap_cm / 100}
    if moves:
        return {"position_m": _beside_taken(sight, moves[0])}
    raise NotReadyError("The sentence names no place.")


def _beside_taken(sight: Looking, delta: dict[str, float]) -> list[float]:
    """A place at a distance from where the cube in the hand was taken."""
    x, y = sight.taken_m
    return [round(x + delta.get("dx_m", 0.0), 4), round(y + delta.get("dy_m", 0.0), 4)]


async def put_down(sight: Looking, text: str) -> str:
    """Put down what is held, by a distance from where it was taken."""
    (delta, *_) = moves_of(text)
    await sight.put(position_m=_beside_taken(sight, delta), speed=_GENTLE)
    return DONE


async def back(sight: Looking, text: str) -> str:
    """Put a cube back where it was first seen or taken."""
    (colour,) = named_colours(text)
    first = sight.at_first[colour]
    await sight.take(colour)
    await sight.put(position_m=list(first))
    return DONE


async def turn(sight: Looking, text: str) -> str:
    """Turn a cube where it stands."""
    await sight.take(named_colours(text)[0])
    turned_deg = math.remainder(sight.taken_deg + (number_before(text, "degrees") or 0.0), 180.0)
    await sight.put(position_m=list(sight.taken_m), yaw_deg=round(turned_deg, 1))
    return DONE


async def push(sight: Looking, text: str) -> str:
    """Push a cube."""
    (colour, *_), (delta, *_) = named_colours(text), moves_of(text)
    await sight.start()
    await sight.tools.must("push", **await sight.pointer(colour, "push"), **delta)
    return DONE


async def swap(sight: Looking, text: str) -> str:
    """Swap two cubes by way of a free place."""
    one, other = named_colours(text)
    cubes = await sight.cubes()
    spare = free_place(cubes)
    for colour, place in (
        (one, spare),
        (other, (cubes[one].x_m, cubes[one].y_m)),
        (one, (cubes[other].x_m, cubes[other].y_m)),
    ):
        await sight.take(colour)
        await sight.put(position_m=list(place))
    return DONE


async def tower(sight: Looking, text: str) -> str:
    """Stack cubes in the order in which they are named."""
    low, middle, top = named_colours(text)
    for below, colour in ((low, middle), (middle, top)):
        await sight.take(colour)
        await sight.put(on=await sight.words_for(below))
    return DONE


async def by_size(sight: Looking, text: str) -> str:
    """Put the smallest cube onto the largest one."""
    smallest, *_, largest = by_edge(await sight.cubes())
    await sight.take(smallest)
    await sight.put(on=await sight.words_for(largest))
    return DONE


async def clear_half(sight: Looking, text: str) -> str:
    """Put every cube of one half onto the other one."""
    sign = 1.0 if re.search(r"the left half", text) else -1.0
    cubes = await sight.cubes()
    for colour in [colour for colour in cubes if cubes[colour].y_m * sign > 0.0]:
        x, y = free_place(cubes, half=-sign)
        await sight.take(colour)
        await sight.put(position_m=[x, y])
        cubes[colour] = Seen(x, y, cubes[colour].edge_m)
    return DONE


async def line_up(sight: Looking, text: str) -> str:
    """Put all cubes into a row along x, beside all of them."""
    step_m = (number_before(text, "cm") or 0.0) / 100
    cubes = await sight.cubes()
    y = 0.3 if sum(cube.y_m for cube in cubes.values()) < 0 else -0.3
    first = 0.5 - step_m * (len(cubes) - 1) / 2
    for number, colour in enumerate(sorted(cubes, key=lambda name: cubes[name].x_m)):
        await sight.take(colour)
        await sight.put(position_m=[round(first + number * step_m, 4), y])
    return DONE
