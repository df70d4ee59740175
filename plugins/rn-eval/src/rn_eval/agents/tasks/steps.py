"""Tool sequences shared by solutions and scripted agents."""

from __future__ import annotations

import io
import time

import anyio
import numpy as np
from PIL import Image

from rn_eval.agents.client import ToolAnswer, ToolClient
from roboneuron import NotReadyError
from roboneuron.sight import segmentation


def visible_colours(encoded: bytes) -> list[str]:
    """Colour words of the visible colours, in the order of `segmentation.HUES_DEG`."""
    with Image.open(io.BytesIO(encoded)) as opened:
        return segmentation.visible_colours(np.asarray(opened.convert("RGB")))


DONE = "CLAIM: done"
_ATTEMPT_S = 25.0


def lifted_until(colour: str) -> dict[str, object]:
    """Predicate: the gripper holds an object, and the cube of this colour is in the air."""
    holds = {"kind": "gripper_holds", "least_open": 0.15, "most_open": 0.85}
    monitor = {"kind": "monitor", "name": "colour-lifted", "options": {"colour": colour}}
    return {"kind": "held", "for_s": 0.5, "of": {"kind": "all", "of": [holds, monitor]}}


async def start_kinds(tools: ToolClient, *kinds: str) -> None:
    """Start these modules unless they run. Raises NotReadyError."""
    for kind in kinds:
        answer = await tools.call(f"start_{kind}")
        if not answer.ok and answer.code != "wrong_state":
            raise NotReadyError(f"start_{kind}: {answer.text}")


async def start_arm(tools: ToolClient) -> None:
    """Start robot and controller, enough for motion tools. Raises NotReadyError."""
    await start_kinds(tools, "robot", "control")


async def try_to_lift(tools: ToolClient, colour: str, max_s: float = 40.0) -> ToolAnswer:
    """Call run_task once to pick up a cube; return its answer."""
    return await tools.call(
        "run_task",
        instruction=f"pick up the {colour} cube",
        until=lifted_until(colour),
        max_s=max_s,
        max_attempts=2,
    )


async def start_everything(tools: ToolClient) -> ToolAnswer:
    """Call start_all; its error that everything runs already counts as success."""
    answer = await tools.call("start_all")
    if answer.code == "wrong_state":
        status = await tools.must("get_status")
        if set(healths(status).values()) <= {"ok", "waiting"}:
            return ToolAnswer(ok=True, data=status.data)
    return answer


async def lift(tools: ToolClient, colour: str) -> None:
    """Start everything and pick up a cube. Raises NotReadyError if that fails."""
    started = await start_everything(tools)
    if not started.ok:
        raise NotReadyError(f"start_all: {started.text}")
    answer = await try_to_lift(tools, colour)
    if answer.data.get("outcome") != "succeeded":
        raise NotReadyError(f"run_task: {answer.text or answer.data}")


async def lift_whatever_happens(
    tools: ToolClient, colour: str, *, within_s: float = 75.0, most_tries: int = 4
) -> None:
    """Pick up a cube; restart modules that fail meanwhile. Raises NotReadyError."""
    last, tries, deadline_s = "", 0, time.monotonic() + within_s
    while tries < most_tries and time.monotonic() < deadline_s:
        started = await start_everything(tools)
        if started.ok:
            tries += 1
            answer = await try_to_lift(tools, colour, _ATTEMPT_S)
            if answer.data.get("outcome") == "succeeded":
                return
            last = answer.text or str(answer.data.get("reason"))
        else:
            last = started.text
            await anyio.sleep(1.0)  # because the server may be restarting a module itself
        await restart_what_is_broken(tools)
    raise NotReadyError(f"run_task: {last}")


async def lift_with(tools: ToolClient, backend: str, colour: str) -> None:
    """Pick up a cube with this policy instead of the configured one. Raises NotReadyError."""
    await start_kinds(tools, "robot", "perception", "control")
    await tools.must("start_inference", backend=backend)
    for _ in range(2):
        ended = await try_to_lift(tools, colour, _ATTEMPT_S)
        if ended.data.get("outcome") == "succeeded":
            return
    raise NotReadyError(f"run_task: {ended.text or ended.data}")


async def wait_until_free(tools: ToolClient, within_s: float = 90.0) -> None:
    """Retry until no other client operates the robot. Raises NotReadyError."""
    deadline_s = time.monotonic() + within_s
    while time.monotonic() < deadline_s:
        answer = await tools.call("start_robot")
        if answer.ok or answer.code == "wrong_state":
            return
        await anyio.sleep(1.0)
    raise NotReadyError(f"start_robot: {answer.text}")


async def restart_what_is_broken(tools: ToolClient) -> None:
    """Stop modules that need it; the next start brings them up again."""
    deadline_s = time.monotonic() + 3.0
    while time.monotonic() < deadline_s:
        status = await tools.must("get_status")
        broken = broken_modules(status)
        for name in broken:
            await tools.call(f"stop_{name}")
        if broken:
            return
        await anyio.sleep(0.3)


_HANGS = ("stalled", "stuck", "silent")
_WAITS = "not_ready"
"""Error of a module that lacks another one's messages: it goes on when they are back."""


def broken_modules(status: ToolAnswer) -> list[str]:
    """Modules that go on only after a restart, from an answer of get_status."""
    modules = status.data.get("modules")
    assert isinstance(modules, list)
    errors = {str(m["module"]): (m.get("error") or {}).get("code") for m in modules}
    return [
        name
        for name, health in healths(status).items()
        if health in _HANGS or (health == "failing" and errors[name] != _WAITS)
    ]


def healths(status: ToolAnswer) -> dict[str, str]:
    """Health by module, from an answer of get_status."""
    modules = status.data.get("modules")
    assert isinstance(modules, list)
    return {str(module["module"]): str(module["health"]) for module in modules}


async def seen_colours(tools: ToolClient) -> list[str]:
    """Start the front camera and return the colours in its image. Raises NotReadyError."""
    await start_kinds(tools, "robot", "perception")
    answer = await tools.must("get_camera_image", camera="front", format="png")
    if not answer.images:
        raise NotReadyError("get_camera_image returned no image.")
    return visible_colours(answer.images[0])


async def newest_fault(tools: ToolClient, **only: object) -> dict[str, object]:
    """The newest incident that is not a restart. Raises NotReadyError if there is none."""
    found = (await tools.must("list_incidents", **only)).data.get("incidents")
    assert isinstance(found, list)
    faults = [one for one in found if one.get("what") != "restart"]
    if not faults:
        raise NotReadyError("list_incidents reports no fault.")
    return dict(faults[0])


async def how_perception_failed(tools: ToolClient) -> str:
    """ "ended" if perception's process exited, otherwise "hung"."""
    newest = await newest_fault(tools, module="perception")
    return "ended" if newest.get("what") == "exited" else "hung"


async def stop_cause(tools: ToolClient) -> str:
    """Who latched the emergency stop and why; "" if it is not latched."""
    return str((await tools.must("get_status")).data.get("emergency_stop_cause") or "")


async def running_modules(tools: ToolClient) -> str:
    """Names of the running modules with commas, or "none"."""
    modules = (await tools.must("get_status")).data.get("modules")
    assert isinstance(modules, list)
    return ", ".join(str(m["module"]) for m in modules if m["phase"] == "running") or "none"


async def count_recordings(tools: ToolClient) -> int:
    """Number of recordings, without those of incidents."""
    runs = (await tools.must("list_recordings")).data.get("runs")
    assert isinstance(runs, list)
    return sum(run.get("kind") == "recording" for run in runs)


async def robot_kind(tools: ToolClient) -> str:
    """ "real" or "simulated"."""
    robot = (await tools.must("get_status")).data.get("robot")
    return str(robot.get("kind")) if isinstance(robot, dict) else "unknown"


def answered(answer: object) -> str:
    """Format last words with an answer."""
    return f"ANSWER: {answer}\n{DONE}"


async def free_hand(tools: ToolClient) -> None:
    """Stop the policy, so that tools can move the arm. Raises NotReadyError."""
    await tools.must("stop_inference")


async def go_by(
    tools: ToolClient, dx_m: float = 0.0, dy_m: float = 0.0, dz_m: float = 0.0, **more: object
) -> None:
    """Move the TCP straight, in pieces of at most 0.4 m. Raises NotReadyError."""
    pieces = max(1, int(max(abs(dx_m), abs(dy_m), abs(dz_m)) / 0.4) + 1)
    for _ in range(pieces):
        delta = {"dx_m": dx_m / pieces, "dy_m": dy_m / pieces, "dz_m": dz_m / pieces}
        await tools.must("move_ee", **{name: round(v, 5) for name, v in delta.items()}, **more)


async def hold_up(
    tools: ToolClient, colour: str, seconds: float, *, most_rounds: int = 30, look_s: float = 1.0
) -> None:
    """Pick up a cube and hold it for this time without interruption; check repeatedly with the call
    that also picks it up again. Raises NotReadyError.
    """
    await lift_whatever_happens(tools, colour)
    since_s = time.monotonic()
    for _ in range(most_rounds):
        if time.monotonic() - since_s >= seconds:
            return
        await anyio.sleep(look_s)
        answer = await try_to_lift(tools, colour, _ATTEMPT_S)
        if answer.data.get("outcome") != "succeeded":
            await lift_whatever_happens(tools, colour)
        if answer.data.get("attempts") != 0:
            since_s = time.monotonic()
    raise NotReadyError(f"run_task: the {colour} cube was never held for {seconds:g} s")


async def put_whatever_happens(
    tools: ToolClient, colour: str, x_m: float, y_m: float, *, most_tries: int = 4
) -> None:
    """Pick up a cube and put it down at a position; retry if the hand loses it. Raises
    NotReadyError.
    """
    last = ""
    for _ in range(most_tries):
        await lift_whatever_happens(tools, colour)
        await free_hand(tools)
        x, y, _ = await tools.tcp_m()
        placed = await tools.call("place", dx_m=round(x_m - x, 4), dy_m=round(y_m - y, 4))
        if placed.ok:
            return
        last = placed.text
    raise NotReadyError(f"place: {last}")
