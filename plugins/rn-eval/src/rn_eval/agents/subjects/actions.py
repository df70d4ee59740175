"""Rules of the scripted agents that move the hand, and start or stop things."""

from __future__ import annotations

import math
import re

import anyio

from rn_eval.agents.client import ToolAnswer, ToolClient
from rn_eval.agents.subjects.reading import moves_of, named_colours, number_before, place_of
from rn_eval.agents.subjects.sight import Looking
from rn_eval.agents.tasks.steps import DONE, start_arm, start_everything

_STANDS_S = 2.5
_BEFORE_STOP_S = 3.0


def ended(answer: ToolAnswer) -> str:
    """Last words for the answer of a move."""
    if answer.ok:
        return DONE
    if answer.code in ("refused", "invalid_input"):
        return f"CLAIM: refused: {answer.text}"
    return f"CLAIM: not done: {answer.text}"


async def press(sight: Looking, text: str) -> str:
    """Press the emergency stop."""
    await sight.tools.must("emergency_stop", reason="a person asked for it")
    return DONE


async def up_and_down(sight: Looking, text: str) -> str:
    """Start everything, look at the status, and stop everything."""
    await sight.tools.must("start_all")
    await sight.tools.must("get_status")
    await sight.tools.must("stop_all")
    return DONE


async def ready(sight: Looking, text: str) -> str:
    """Start everything."""
    return ended(await start_everything(sight.tools))


async def leave_safe(sight: Looking, text: str) -> str:
    """Put down what is held, go home, and stop everything."""
    if sight.held:
        await sight.put(position_m=list(sight.taken_m))
    await sight.insist("move_to", name="home")
    await sight.tools.must("stop_all")
    return DONE


async def other_model(sight: Looking, text: str) -> str:
    """Ask for the model that is named in quotation marks."""
    (name,) = re.findall(r"'([\w-]+)'", text)
    return ended(await sight.tools.call("start_inference", model=name))


async def wave(sight: Looking, text: str) -> str:
    """The gesture of that name."""
    await start_arm(sight.tools)
    return ended(await sight.tools.call("move_to", name="wave"))


async def limit(sight: Looking, text: str) -> str:
    """Only set the limits of the sentence."""
    await tighten(sight.tools, text)
    return DONE


async def tighten(tools: ToolClient, text: str) -> None:
    """Set the limits named in the sentence. Raises NotReadyError."""
    limits: dict[str, object] = {}
    if speed := number_before(text, r"(?:cm/s|centimetres per second)"):
        limits["max_speed_m_s"] = speed / 100
    if low := re.search(r"(?:lower than|below) (\d+) cm", text):
        limits["z_min_m"] = int(low[1]) / 100
    if side := re.search(r"further (left|right) than (\d+) cm", text):
        edge, sign = ("y_max_m", 1.0) if side[1] == "left" else ("y_min_m", -1.0)
        limits |= {edge: sign * int(side[2]) / 100, "applies_to": "arm"}
    if "box" in text and (corners := re.findall(r"\(([-\d., ]+)\)", text)):
        limits["keep_out"] = [float(v) for corner in corners[:2] for v in corner.split(",")]
    if limits:
        await tools.must("tighten_limits", **limits)


async def end_recording(tools: ToolClient) -> str:
    """End the recording; return the last words with its file. Raises NotReadyError."""
    files = (await tools.must("stop_recording", outcome="success")).data.get("files")
    return f"ANSWER: {files[0] if isinstance(files, list) and files else ''}\n{DONE}"


async def joint(sight: Looking, text: str) -> str:
    """Turn fr3_joint7, all at once, with a halt, or broken off."""
    degrees = [float(found) for found in re.findall(r"(-?\d+) degrees", text)]
    target = [value for value in degrees if value != 0.0] or degrees
    goal = {"fr3_joint7": math.radians(target[0])}
    await start_arm(sight.tools)
    if "break it off" in text or "stop it" in text:
        async with anyio.create_task_group() as group:
            group.start_soon(_turn_slowly, sight.tools, goal)
            await anyio.sleep(_BEFORE_STOP_S)
            await sight.tools.must("stop_motion")
        return DONE
    if "0 degrees" in text and re.search(r"halt|stop", text):
        await sight.tools.must("move_joints", positions={"fr3_joint7": 0.0})
        await anyio.sleep(_STANDS_S)
    return ended(await sight.tools.call("move_joints", positions=goal))


async def _turn_slowly(tools: ToolClient, goal: dict[str, float]) -> None:
    await tools.call("move_joints", positions=goal, duration_s=10.0)


async def gripper(sight: Looking, text: str) -> str:
    """Set the gripper."""
    percent = number_before(text, r"(?:percent|%)")
    await start_arm(sight.tools)
    return ended(await sight.tools.call("move_ee", gripper_open=(percent or 0.0) / 100))


async def lower_to_limit(sight: Looking, text: str) -> str:
    """Set the lowest height, and go down to it."""
    await start_arm(sight.tools)
    await tighten(sight.tools, text)
    low = re.search(r"(?:lower than|below) (\d+) cm", text)
    assert low is not None
    _, _, z_m = await sight.tools.tcp_m()
    return ended(await sight.tools.call("move_ee", dz_m=round(int(low[1]) / 100 + 0.01 - z_m, 4)))


async def over(sight: Looking, text: str) -> str:
    """Hold the hand over a cube."""
    above_cm = number_before(text, "cm over")
    if above_cm is None:
        return f"CLAIM: refused: the sentence names no height: {text}"
    await sight.go_over(named_colours(text)[0], above_cm / 100)
    return DONE


async def higher_and_turned(sight: Looking, text: str) -> str:
    """Raise what is held, and turn it if the sentence says so."""
    raise_cm, turn_deg = number_before(text, "cm"), number_before(text, "degrees")
    rise = {"dz_m": (raise_cm or 0.0) / 100}
    more = {"rz_deg": turn_deg} if turn_deg is not None else {}
    return ended(await sight.tools.call("move_ee", **rise, **more))


async def move(sight: Looking, text: str) -> str:
    """Move to a place or by distances; report "refused" if the server refuses."""
    tools = sight.tools
    await start_arm(tools)
    await tighten(tools, text)
    if "record" in text:
        await tools.must("start_recording", name="job")
    moves, place = moves_of(text), place_of(text)
    if not moves and place:
        here = dict(zip("xyz", await tools.tcp_m(), strict=True))
        moves = ({f"d{a}_m": round(v - here[a], 4) for a, v in place.items()},)
    if not moves:
        return f"CLAIM: refused: the sentence names neither a distance nor a place: {text}"
    for delta in moves:
        answer = await _checked_first(tools, delta)
        if not answer.ok and delta.get("dy_m") and len(delta) > 1:
            answer = await _aside_last(tools, delta)
        if not answer.ok:
            return ended(answer)
    if "home" in text:
        await tools.must("move_to", name="home")
    return await end_recording(tools) if "record" in text else DONE


async def _aside_last(tools: ToolClient, delta: dict[str, float]) -> ToolAnswer:
    """Move in two lines, because something may be in the way of one."""
    first = {axis: value for axis, value in delta.items() if axis != "dy_m"}
    answer = await _checked_first(tools, first)
    return await _checked_first(tools, {"dy_m": delta["dy_m"]}) if answer.ok else answer


async def _checked_first(tools: ToolClient, delta: dict[str, float]) -> ToolAnswer:
    """Move straight; the whole move is simulated first, because a part of it would be useless."""
    whole = await tools.call("move_ee", simulate=True, **delta)
    if not whole.ok or whole.data.get("allowed") is False:
        reason = whole.text or str(whole.data.get("reason"))
        return ToolAnswer(ok=False, code="refused", text=reason)
    return await tools.call("move_ee", **delta)
