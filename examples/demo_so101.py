"""A simulated SO-101 picks a cube up: one MCP client, visual servoing, the simulator as the judge.

    make demo-so101      or      python examples/demo_so101.py [--seed 7] [--colour blue]

Exit status 0 means that the simulator saw the cube lifted by 4 cm for a second. Film strip, GIF and
the server's log go to `out/demo-so101/`.
"""

from __future__ import annotations

import json
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import anyio
from cube_demo import run_demo

from rn_standard.demo.agent import DemoAgent, module_status
from rn_standard.demo.film import DemoFilm
from roboneuron import NotReadyError

CONFIG = Path(__file__).with_name("so101.toml")
COLOURS = ("red", "green", "blue")
HELD_S, TIMEOUT_S, LOOK_S = 1.0, 90.0, 0.25


async def play(agent: DemoAgent, colour: str, film: DemoFilm) -> bool:
    """Run the task; return whether the cube is held according to the simulator."""
    film.add(0.0, "before", await agent.image("front"))
    await agent.call("start_inference", {"instruction": f"pick up the {colour} cube"})
    begun_s, told, cube = time.monotonic(), "", dict[str, Any]()
    while time.monotonic() - begun_s < TIMEOUT_S:
        status = await agent.status()
        since_s = time.monotonic() - begun_s
        note = str(module_status(status, "inference").get("note") or "")
        if note and note != told:
            told = note
            print(f"  {since_s:5.1f} s  {note}", flush=True)
        with suppress(NotReadyError):  # a film may lack a frame
            film.add(since_s, note, await agent.image("front"))
        detail = module_status(status, "robot").get("detail") or {}
        cube = json.loads(detail.get("cubes", "{}")).get(colour, {})
        if cube.get("held_s", 0.0) >= HELD_S:
            break
        await anyio.sleep(LOOK_S)
    print(f"  the simulator says: {cube}", flush=True)
    return bool(cube.get("held_s", 0.0) >= HELD_S)


if __name__ == "__main__":
    status = run_demo(
        __doc__ or "",
        robot="so101",
        config=CONFIG,
        task="pick up the {colour} cube",
        colours=COLOURS,
        play=play,
    )
    sys.exit(status)
