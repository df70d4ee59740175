"""Shared parts of the demonstrations with cubes: options, a server, and the film."""

from __future__ import annotations

import argparse
import random
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from pathlib import Path

from rn_standard.console.client import spawned_server
from rn_standard.demo.agent import DemoAgent
from rn_standard.demo.film import DemoFilm
from rn_standard.demo.pace import MachinePace, run_paced
from roboneuron import RoboNeuronError

Play = Callable[[DemoAgent, str, DemoFilm], Awaitable[bool]]
"""Acts on the cube of a colour with everything but inference started; returns whether it
succeeded.
"""


def run_demo(
    description: str, *, robot: str, config: Path, task: str, colours: Sequence[str], play: Play
) -> int:
    """Read the command line, start a server with a scene, play, and save the film.

    Args:
        description: for `--help`.
        robot: name of the plugin section with the option `seed`.
        config: the configuration without the seed; the output goes to out/demo-<its name>.
        task: the task, such as "pick up the {colour} cube".
        colours: colours of the cubes; the first is the default.
        play: the demonstration.

    Returns:
        The exit status, see `run_paced`.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--seed", type=int, default=None, help="of the scene; default: a new one")
    parser.add_argument("--colour", choices=colours, default=colours[0])
    parser.add_argument("--output", type=Path, default=Path(f"out/demo-{config.stem}"))
    chosen = parser.parse_args()
    seed = random.SystemRandom().randrange(10_000) if chosen.seed is None else chosen.seed
    chosen.output.mkdir(parents=True, exist_ok=True)
    copy = chosen.output / config.name
    text = config.read_text(encoding="utf-8")
    copy.write_text(f"{text}\n[plugins.{robot}]\nseed = {seed}\n", encoding="utf-8")
    print(f"scene {seed}: {task.format(colour=chosen.colour)}", flush=True)

    async def run(pace: MachinePace) -> bool:
        film = DemoFilm()
        async with spawned_server(["--config", str(copy)], chosen.output / "server.log") as client:
            agent = DemoAgent(client, pace)
            try:
                for tool in ("start_robot", "start_perception", "start_control"):
                    await agent.call(tool)
                    print(f"  {tool}", flush=True)
                succeeded = await play(agent, chosen.colour, film)
            finally:
                with suppress(RoboNeuronError):  # the server ends next, with everything in it
                    await agent.call("stop_all")
        strip, gif = film.save(chosen.output)
        print(f"  film strip  {strip}\n  film  {gif}")
        return succeeded

    return run_paced(run)
