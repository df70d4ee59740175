"""Rules of the scripted agent for several robots behind one server."""

from __future__ import annotations

import math
import re

import anyio

from rn_eval.agents.client import ToolClient
from rn_eval.agents.subjects.reading import moves_of
from rn_eval.agents.tasks.driving import drive, start_base, turn
from rn_eval.agents.tasks.steps import DONE, lift_whatever_happens
from roboneuron import NotReadyError

PATTERN = r"(?:left|right) robot|mobile base"
_STOP = re.compile(r"emergency stop (?:of|for) the (\w+) robot")
_ITS = re.compile(r"(left|right) robot (?:is to )?(?:pick up )?its (\w+) cube")
_WITH = re.compile(r"the (\w+) cube with the (left|right) robot")
_ARM = re.compile(r"(?:its|lift the) (\w+) cube")
_TURN = re.compile(r"(\d+) degrees to the (left|right)|to the (left|right) by (\d+) degrees")
_ARMS_KIND = "fr3"
_WITHIN_S = 100.0


async def several(tools: ToolClient, text: str) -> str:
    """Stop, drive and pick as the sentence says, each with the robot it names."""
    if stopped := _STOP.search(text):
        await tools.of(stopped[1]).must("emergency_stop", reason="a person asked for it")
    picks = [(found[1], found[2]) for found in _ITS.finditer(text)]
    picks += [(found[2], found[1]) for found in _WITH.finditer(text)]
    if "mobile base" in text:
        arms, bases = await names_of(tools)
        if not bases:
            raise NotReadyError("list_fleet names no mobile base.")
        picks += [(arms[0], found[1]) for found in _ARM.finditer(text)]
        await _drive(tools.of(bases[0]), text)
    for robot, colour in picks:
        await lift_whatever_happens(tools.of(robot), colour, within_s=_WITHIN_S)
        if len(picks) > 1:
            await tools.of(robot).call("stop_inference")
    return DONE


async def names_of(tools: ToolClient) -> tuple[list[str], list[str]]:
    """Names of the arms and of the other robots of a server with several robots. Raises
    NotReadyError.
    """
    robots = (await tools.must("list_fleet")).data.get("robots")
    assert isinstance(robots, list)
    arms = [str(one["name"]) for one in robots if one["robot"] == _ARMS_KIND]
    others = [str(one["name"]) for one in robots if one["robot"] != _ARMS_KIND]
    if not arms:
        raise NotReadyError("list_fleet names no arm.")
    return arms, others


async def _drive(base: ToolClient, text: str) -> None:
    await start_base(base)
    await anyio.sleep(0.5)  # time for the first odometry
    for move in moves_of(text):
        await drive(base, move.get("dx_m", 0.0))
    if found := _TURN.search(text):
        side, degrees = (found[2], found[1]) if found[2] else (found[3], found[4])
        await turn(base, math.radians(float(degrees)) * (1.0 if side == "left" else -1.0))
