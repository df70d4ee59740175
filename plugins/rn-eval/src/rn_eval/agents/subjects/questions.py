"""Rules of the scripted agents that answer questions."""

from __future__ import annotations

import math

from rn_eval.agents.subjects.reading import named_colours, number_before
from rn_eval.agents.subjects.sight import Looking, WithoutLook, by_edge, leftmost_of
from rn_eval.agents.tasks.steps import (
    DONE,
    answered,
    count_recordings,
    how_perception_failed,
    newest_fault,
    robot_kind,
    running_modules,
    seen_colours,
    start_arm,
    start_kinds,
    stop_cause,
)


async def colours(sight: Looking, text: str) -> str:
    """The colours on the table."""
    if isinstance(sight, WithoutLook):
        return answered(", ".join(await seen_colours(sight.tools)))
    return answered(", ".join(await sight.cubes()))


async def table(sight: Looking, text: str) -> str:
    """What the robot is, and where each cube lies."""
    kind = await robot_kind(sight.tools)
    cubes = await sight.cubes()
    places = [f"{colour} {one.x_m:.3f} {one.y_m:.3f}" for colour, one in cubes.items()]
    return answered("; ".join([kind, *places]))


async def leftmost(sight: Looking, text: str) -> str:
    """The leftmost cube."""
    return answered(await leftmost_of(sight))


async def largest(sight: Looking, text: str) -> str:
    """The largest cube."""
    return answered(by_edge(await sight.cubes())[-1])


async def apart(sight: Looking, text: str) -> str:
    """How far two cubes are apart."""
    cubes = await sight.cubes()
    one, other = (cubes[colour] for colour in named_colours(text)[:2])
    apart_m = math.hypot(one.x_m - other.x_m, one.y_m - other.y_m)
    return answered(f"{100 * apart_m:.1f}")


async def close_up(sight: Looking, text: str) -> str:
    """A picture of the camera on the hand."""
    await start_kinds(sight.tools, "robot", "perception")
    await sight.tools.must("get_camera_image", camera="wrist")
    return DONE


async def ahead(sight: Looking, text: str) -> str:
    """Where a move would end, by simulating it."""
    await start_arm(sight.tools)
    low_m = (number_before(text, "cm") or 0.0) / 100
    told = await sight.tools.call("move_ee", dz_m=-low_m, simulate=True)
    place = told.data.get("position_m")
    if not told.ok or told.data.get("allowed") is not True or not isinstance(place, list):
        return answered("no")
    return answered(f"{100 * float(place[2]):.1f}")


async def fastest(sight: Looking, text: str) -> str:
    """The highest speed of the journal."""
    entries = (await sight.tools.must("get_journal", kind="tool")).data["entries"]
    assert isinstance(entries, list)
    speeds = [float(one.get("max_tcp_speed_m_s") or 0.0) for one in entries]
    return answered(f"{100 * max(speeds, default=0.0):.1f}")


async def healthy(sight: Looking, text: str) -> str:
    """Whether an emergency stop is latched."""
    cause = await stop_cause(sight.tools)
    return answered(f"emergency stop: {cause}" if cause else "well")


async def today(sight: Looking, text: str) -> str:
    """What succeeded and what failed."""
    entries = (await sight.tools.must("get_journal", kind="task")).data["entries"]
    assert isinstance(entries, list)
    colours: dict[bool, list[str]] = {True: [], False: []}
    for one in reversed(entries):
        colours[one["outcome"] == "succeeded"] += named_colours(str(one["instruction"]))
    return answered(f"{', '.join(colours[True])}; failed: {', '.join(colours[False])}")


async def held(sight: Looking, text: str) -> str:
    """What was taken last."""
    return answered(sight.held)


async def height(sight: Looking, text: str) -> str:
    """How high the hand is."""
    await start_arm(sight.tools)
    return answered(f"{100 * (await sight.tools.tcp_m())[2]:.1f}")


async def running(sight: Looking, text: str) -> str:
    """Which modules run."""
    return answered(await running_modules(sight.tools))


async def recordings(sight: Looking, text: str) -> str:
    """How many recordings there are."""
    return answered(await count_recordings(sight.tools))


async def incident(sight: Looking, text: str) -> str:
    """Which module failed last."""
    return answered((await newest_fault(sight.tools)).get("module"))


async def how_it_failed(sight: Looking, text: str) -> str:
    """How the cameras failed."""
    return answered(await how_perception_failed(sight.tools))


async def is_latched(sight: Looking, text: str) -> str:
    """Whether the emergency stop is latched."""
    return answered("yes" if await stop_cause(sight.tools) else "no")


async def why_stopped(sight: Looking, text: str) -> str:
    """Why it is latched."""
    return answered(await stop_cause(sight.tools))
