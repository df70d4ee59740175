"""A simulated SO-101 picks a cube up: one MCP client, visual servoing, the simulator as the judge.

    make demo-so101      or      python examples/demo_so101.py [--seed 7] [--colour blue]

Exit status 0 means that the simulator saw the cube lifted by 4 cm for a second. Film strip, GIF and
the server's log go to `out/demo-so101/`.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import anyio

from rn_standard.console.client import spawned_server
from rn_standard.demo.agent import Agent, module_status
from rn_standard.demo.film import DemoFilm
from roboneuron import NotReadyError, RoboNeuronError

CONFIG = Path(__file__).with_name("so101.toml")
COLOURS = ("red", "green", "blue")
HELD_S, TIMEOUT_S, LOOK_S = 1.0, 90.0, 0.25


async def play(agent: Agent, colour: str, film: DemoFilm) -> dict[str, Any]:
    """Start everything, have the cube picked up, and return what the simulator says of it."""
    for tool in ("start_robot", "start_perception", "start_control"):
        await agent.call(tool)
        print(f"  {tool}", flush=True)
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
        with suppress(NotReadyError):  # a film with a missing frame is still a film
            film.add(since_s, note, await agent.image("front"))
        detail = module_status(status, "robot").get("detail") or {}
        cube = json.loads(detail.get("cubes", "{}")).get(colour, {})
        if cube.get("held_s", 0.0) >= HELD_S:
            break
        await anyio.sleep(LOOK_S)
    return cube


async def main() -> int:
    """0 when the cube was lifted and held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=None, help="of the scene; default: a new one")
    parser.add_argument("--colour", choices=COLOURS, default="red")
    parser.add_argument("--output", type=Path, default=Path("out/demo-so101"))
    chosen = parser.parse_args()
    seed = random.SystemRandom().randrange(10_000) if chosen.seed is None else chosen.seed
    chosen.output.mkdir(parents=True, exist_ok=True)
    config = chosen.output / "so101.toml"
    text = CONFIG.read_text(encoding="utf-8")
    config.write_text(f"{text}\n[plugins.so101]\nseed = {seed}\n", encoding="utf-8")
    print(f"scene {seed}: pick up the {chosen.colour} cube", flush=True)
    film = DemoFilm()
    async with spawned_server(["--config", str(config)], chosen.output / "server.log") as client:
        agent = Agent(client)
        try:
            cube = await play(agent, chosen.colour, film)
        finally:
            with suppress(RoboNeuronError):  # the server ends next and takes what is left along
                await agent.call("stop_all")
    strip, gif = film.save(chosen.output)
    print(f"  the simulator says: {cube}\n  film strip  {strip}\n  film  {gif}")
    return 0 if cube.get("held_s", 0.0) >= HELD_S else 1


if __name__ == "__main__":
    sys.exit(anyio.run(main))
