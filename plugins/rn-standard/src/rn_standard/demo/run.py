"""Steps of the demo: connect, start, instruct, monitor, stop; the simulator decides on success."""

from __future__ import annotations

import json
import math
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from rn_standard.console.client import spawned_server
from rn_standard.demo.agent import DemoAgent, DemoObject, module_status, simulated_objects
from rn_standard.demo.film import DemoFilm
from rn_standard.demo.pace import MachinePace
from rn_standard.demo.screen import HOLD_GOAL_S, LIFT_GOAL_M, DemoScreen
from roboneuron import ConfigurationError, NotReadyError, RoboNeuronError
from roboneuron.command import load_config
from roboneuron.feature import reading

_LOOK_PERIOD_S = 0.25
_PATIENCE_S = 3.0
"""Duration of a reported error that counts; a late image on a busy machine is reported and cleared
with the next one.
"""
_STOPS = ("stop_inference", "stop_control", "stop_perception", "stop_robot")


@dataclass(frozen=True, kw_only=True, slots=True)
class DemoOptions:
    """Options chosen by the user.

    Attributes:
        instruction: for the policy; also names the object that has to be lifted.
        seed: seed of the scene; None for the configured one.
        gui: show the simulator's window.
        max_s: give up after this long.
        output: directory for film strip, GIF and server log.
        config: a configuration file instead of the embedded default.
    """

    instruction: str
    seed: int | None
    gui: bool
    max_s: float
    output: Path
    config: Path | None


def write_configuration(options: DemoOptions, directory: Path) -> Path:
    """Write the configuration of the server; return its path."""
    config = load_config(options.config)
    # without the mark that an editor may have put in front
    text = options.config.read_text("utf-8-sig") if options.config else reading.default_text()
    chosen: dict[str, object] = {}
    if options.seed is not None:
        chosen["seed"] = options.seed
    if options.gui:
        chosen["gui"] = True
    name = config.robot.name
    if twice := chosen.keys() & config.plugins.get(name, {}).keys():
        raise ConfigurationError(
            f"{options.config} has {' and '.join(sorted(twice))} for {name!r} too: leave one out."
        )
    header = f"[plugins.{name}]\n"
    if name not in config.plugins:
        text += f"\n{header}"
    if header not in text:
        raise ConfigurationError(
            f"{options.config} has options for {name!r} in a form that cannot be added to."
        )
    text = text.replace(
        header,
        header + "".join(f"{key} = {json.dumps(value)}\n" for key, value in chosen.items()),
        1,
    )
    path = directory / "roboneuron.toml"
    path.write_text(text, encoding="utf-8")
    return path


def named_object(objects: list[DemoObject], instruction: str) -> DemoObject:
    """The one object named in the instruction.

    Raises:
        ConfigurationError: none or several are named.
    """
    words = instruction.lower().replace(",", " ").replace(".", " ").split()
    named = [thing for thing in objects if thing.name in words]
    if len(named) != 1:
        choices = ", ".join(sorted(thing.name for thing in objects)) or "nothing"
        raise ConfigurationError(
            f"The instruction {options_quote(instruction)} names {len(named)} objects of this "
            "scene, expected one.",
            hint=f"On the table: {choices}.",
        )
    return named[0]


def options_quote(text: str) -> str:
    """`text` in typographic quotes, for messages."""
    return f"“{text}”"


async def run_demo(options: DemoOptions, console: Console, pace: MachinePace) -> bool:
    """Run the demo; return True if the named object was lifted and held according to the
    simulator.
    """
    options.output.mkdir(parents=True, exist_ok=True)
    screen = DemoScreen(console)
    screen.title(options.instruction, options.seed)
    path = write_configuration(options, options.output)
    log_path = options.output / "server.log"
    film = DemoFilm()
    async with spawned_server(["--config", str(path)], log_path) as client:
        agent = DemoAgent(client, pace)
        try:
            success = await _play(agent, options, screen, film)
        finally:
            await _stop_everything(agent, screen)
    if film.frames:
        strip, gif = film.save(options.output)
        console.print(
            f"  film strip  {strip}\n  film        {gif}\n  server log  {log_path}", highlight=False
        )
    return success


async def _play(agent: DemoAgent, options: DemoOptions, screen: DemoScreen, film: DemoFilm) -> bool:
    with screen.step("connect to the MCP server") as told:
        tools = await agent.tools()
        told.append(f"{len(tools)} typed tools")
    for module, tool in (
        ("robot", "start_robot"),
        ("perception", "start_perception"),
        ("control", "start_control"),
    ):
        with screen.step(f"start {module}") as told:
            started_s = time.monotonic()
            await agent.call(tool)
            pid = module_status(await agent.status(), module).get("pid")
            told.append(f"process {pid}, ready after {time.monotonic() - started_s:.1f} s")
    target = named_object(simulated_objects(await agent.status()), options.instruction)
    with screen.step("look through the front camera") as told:
        image = await agent.image("front")
        film.add(0.0, "before", image)
        told.append(f"{len(image) / 1024:.0f} KiB")
    with screen.step("start inference with the instruction") as told:
        started_s = time.monotonic()
        await agent.call("start_inference", {"instruction": options.instruction})
        told.append(f"first action after {time.monotonic() - started_s:.1f} s")
    success, status = await _watch(agent, target.name, options, screen, film)
    screen.summary(list(status.get("modules", ())))
    return success


async def _watch(
    agent: DemoAgent, name: str, options: DemoOptions, screen: DemoScreen, film: DemoFilm
) -> tuple[bool, dict[str, Any]]:
    """Monitor until the simulator reports success, the backend gives up, or the time is over."""
    started_s = time.monotonic()
    status: dict[str, Any] = {}
    last_note = ""
    faulty_since_s = math.inf
    with screen.watching() as live:
        while (elapsed_s := time.monotonic() - started_s) < options.max_s:
            status = await agent.status()
            inference = module_status(status, "inference")
            note = str(inference.get("note") or "")
            if note and note != last_note:
                screen.say(f"{elapsed_s:5.1f} s  {note}")
                last_note = note
            thing = next(t for t in simulated_objects(status) if t.name == name)
            live.update(screen.progress(name, thing.lifted_m, thing.held_s, note, elapsed_s))
            with suppress(NotReadyError):  # a missing frame does not matter
                film.add(elapsed_s, note, await agent.image("front"))
            if thing.held_s >= HOLD_GOAL_S:
                break
            error = inference.get("error") or {}
            faulty_since_s = min(faulty_since_s, elapsed_s) if error else math.inf
            if elapsed_s - faulty_since_s > _PATIENCE_S:
                screen.say(f"inference: {error.get('message', error)}")
                break
    thing = next(t for t in simulated_objects(status) if t.name == name)
    success = thing.held_s >= HOLD_GOAL_S
    verdict = "[bold green]lifted[/]" if success else "[bold red]not lifted[/]"
    screen.console.print(
        f"  {'✓' if success else '✗'} the simulator says: {name} {verdict} by "
        f"{thing.lifted_m * 100:.1f} cm,"
        f" held for {thing.held_s:.1f} s (needed {LIFT_GOAL_M * 100:.0f} cm for {HOLD_GOAL_S:.0f} "
        "s)",
        highlight=False,
    )
    return success, status


async def _stop_everything(agent: DemoAgent, screen: DemoScreen) -> None:
    running = {m["module"] for m in (await agent.status())["modules"] if m.get("pid") is not None}
    with screen.step("stop everything"):
        for tool in _STOPS:
            if tool.removeprefix("stop_") in running:
                with suppress(RoboNeuronError):  # the server ends next and stops the rest
                    await agent.call(tool)
