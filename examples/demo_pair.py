"""Two FR3s at one table: the left one picks a cube up and hands it to the right one.

    make demo-pair      or      python examples/demo_pair.py [--seed 7] [--colour blue]

An MCP client starts the modules and calls `run_task`, whose predicate uses the simulator's ground
truth: the cube has been held by the other arm alone for a second, and was in the air throughout.
Exit status 0 means that it holds. Film strip, GIF and the server's log go to `out/demo-pair/`.
"""

from __future__ import annotations

import json
import sys
import time
from contextlib import suppress
from pathlib import Path

import anyio
from cube_demo import run_demo

from rn_standard.demo.agent import DemoAgent, module_status
from rn_standard.demo.film import DemoFilm
from roboneuron import NotReadyError

CONFIG = Path(__file__).with_name("pair.toml")
COLOURS = ("red", "green", "blue", "yellow")
HANDED_OVER = {
    "kind": "field",
    "topic": "sim/handed_over",
    "type": "std_msgs/msg/Float64",
    "field": "data",
    "at_least": 1.0,
}
ATTEMPT_S, ATTEMPTS, LOOK_S = 90.0, 2, 0.3


async def play(agent: DemoAgent, colour: str, film: DemoFilm) -> bool:
    """Run the handover; return whether run_task reports success."""
    answer: dict[str, object] = {}
    begun_s = time.monotonic()
    async with anyio.create_task_group() as group:

        async def watch() -> None:
            note = ""
            while True:
                with suppress(NotReadyError):  # a film may lack a frame
                    status = await agent.status()
                    now = str(module_status(status, "inference").get("note") or "")
                    if now and now != note:
                        note = now
                        print(f"  {time.monotonic() - begun_s:5.1f} s  {note}", flush=True)
                    film.add(time.monotonic() - begun_s, note, await agent.image("front"))
                await anyio.sleep(LOOK_S)

        group.start_soon(watch)
        arguments = {"instruction": f"hand over the {colour} cube", "until": HANDED_OVER}
        limits = {"max_s": ATTEMPT_S, "max_attempts": ATTEMPTS}
        answer = await agent.call("run_task", {**arguments, **limits})
        group.cancel_scope.cancel()
    detail = module_status(await agent.status(), "robot").get("detail") or {}
    cube = json.loads(detail.get("cubes", "{}"))[colour]
    print(f"  the simulator says: {cube}", flush=True)
    print(f"  {answer['outcome']}: {answer['reason']}", flush=True)
    return answer["outcome"] == "succeeded"


if __name__ == "__main__":
    status = run_demo(
        __doc__ or "",
        robot="fr3-pair",
        config=CONFIG,
        task="hand over the {colour} cube",
        colours=COLOURS,
        play=play,
    )
    sys.exit(status)
