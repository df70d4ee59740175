"""Two FR3s at one table: the left one picks a cube up and hands it to the right one.

    make demo-pair      or      python examples/demo_pair.py [--seed 7] [--colour blue]

An MCP client starts the modules and calls `run_task`, whose predicate is what the simulator says:
the cube has been held by the other arm alone for a second, and has been in the air all the time.
Exit status 0 means that it says yes. Film strip, GIF and the server's log go to `out/demo-pair/`.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from contextlib import suppress
from pathlib import Path

import anyio

from rn_standard.console.client import spawned_server
from rn_standard.demo.agent import Agent, module_status
from rn_standard.demo.film import DemoFilm
from roboneuron import NotReadyError, RoboNeuronError

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


async def play(agent: Agent, colour: str, film: DemoFilm) -> dict[str, object]:
    """Start everything and have the cube handed over; the answer of run_task."""
    for tool in ("start_robot", "start_perception", "start_control"):
        await agent.call(tool)
        print(f"  {tool}", flush=True)
    answer: dict[str, object] = {}
    begun_s = time.monotonic()
    async with anyio.create_task_group() as group:

        async def watch() -> None:
            note = ""
            while True:
                with suppress(NotReadyError):  # a film with a missing frame is still a film
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
    return answer


async def main() -> int:
    """0 when the cube was handed over."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=None, help="of the scene; default: a new one")
    parser.add_argument("--colour", choices=COLOURS, default="red")
    parser.add_argument("--output", type=Path, default=Path("out/demo-pair"))
    chosen = parser.parse_args()
    seed = random.SystemRandom().randrange(10_000) if chosen.seed is None else chosen.seed
    chosen.output.mkdir(parents=True, exist_ok=True)
    config = chosen.output / "pair.toml"
    text = CONFIG.read_text(encoding="utf-8")
    config.write_text(f"{text}\n[plugins.fr3-pair]\nseed = {seed}\n", encoding="utf-8")
    print(f"scene {seed}: hand over the {chosen.colour} cube", flush=True)
    film = DemoFilm()
    async with spawned_server(["--config", str(config)], chosen.output / "server.log") as client:
        agent = Agent(client)
        try:
            answer = await play(agent, chosen.colour, film)
        finally:
            with suppress(RoboNeuronError):  # the server ends next and takes what is left along
                await agent.call("stop_all")
    strip, gif = film.save(chosen.output)
    print(f"  {answer['outcome']}: {answer['reason']}\n  film strip  {strip}\n  film  {gif}")
    return 0 if answer["outcome"] == "succeeded" else 1


if __name__ == "__main__":
    sys.exit(anyio.run(main))
