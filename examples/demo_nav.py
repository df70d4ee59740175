"""An agent lets nav2's NavigateToPose drive a simulated base to the table, then a simulated FR3
picks up a cube.

    make demo-nav      or      python examples/demo_nav.py [--seed 7] [--colour red]

The agent is an ordinary MCP client of one server (`demo_nav.toml`). The base's navigator is a
stand-in (`nav_standin.py`), a separate process with the public definition of the action. The agent
first requests a place in a zone, which must be refused, then the table; the arm starts only after
the base has arrived. Base and arm are two simulations: the base does not carry the arm. Each
simulator is the judge: the base stands within 10 cm and 0.15 rad of the place at the table, and the
cube is 10 cm up and has been held for a second. Exit status 0 means that both say yes and that the
zone was refused.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import anyio
from demo_fleet import Work, judge_arm, lifted, true_pose
from rich.console import Console
from rich.panel import Panel
from rich.table import Table

from rn_simulation.planar_motion import PlanarPose
from rn_standard.console.client import leaves_of, spawned_server
from rn_standard.demo.agent import DemoAgent, simulated_objects
from rn_standard.demo.pace import MachinePace, run_paced
from rn_standard.demo.screen import HOLD_GOAL_S, DemoScreen
from roboneuron import NotReadyError, RoboNeuronError

HERE = Path(__file__).parent
ARM, BASE = "arm", "base"
COLOURS = ("red", "green", "blue", "yellow")
TABLE = PlanarPose(x_m=1.2, y_m=0.5, yaw_rad=math.pi / 2)
"""Goal of the base."""
STAIRS_M = (0.0, 1.2)
"""A place in the zone."""
NEAR_M, NEAR_RAD = 0.1, 0.15
ATTEMPT_S, ATTEMPTS, HELD_S, REST_S = 60.0, 3, 5.0, 1.5
WHOLE_S = 420.0


def pose_goal(x_m: float, y_m: float, yaw_rad: float) -> dict[str, object]:
    """Goal arguments for a pose on the map."""
    rotation = {"z": math.sin(yaw_rad / 2), "w": math.cos(yaw_rad / 2)}
    pose = {"position": {"x": x_m, "y": y_m}, "orientation": rotation}
    return {"pose": {"header": {"frame_id": "map"}, "pose": pose}}


def is_at_table(pose: PlanarPose | None) -> bool:
    """True if the base is at the table, according to the simulator."""
    if pose is None:
        return False
    off_rad = abs(math.remainder(pose.yaw_rad - TABLE.yaw_rad, 2 * math.pi))
    off_m = math.dist((pose.x_m, pose.y_m), (TABLE.x_m, TABLE.y_m))
    return off_m <= NEAR_M and off_rad <= NEAR_RAD


@contextmanager
def navigator(output: Path) -> Iterator[None]:
    """Run the stand-in for nav2 within the context; the type of its action is learnt into a store
    below `output`.

    Raises:
        NotReadyError: the type cannot be learnt, or the stand-in does not start.
    """
    os.environ["XDG_DATA_HOME"] = str((output / "data").resolve())
    os.environ["XDG_CACHE_HOME"] = str((output / "cache").resolve())
    program = [sys.executable, "-P", "-m", "roboneuron.cli.main", "ros", "learn"]
    learnt = subprocess.run(
        [*program, str(HERE / "ros")], capture_output=True, text=True, check=False
    )
    if learnt.returncode:
        raise NotReadyError(f"NavigateToPose cannot be learnt: {learnt.stderr.strip()}")
    command = [sys.executable, str(HERE / "nav_standin.py"), "--namespace", BASE]
    with (
        (output / "navigator.log").open("w", encoding="utf-8") as log,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True) as process,
    ):
        try:
            assert process.stdout is not None
            if not any("is offered" in line for line in process.stdout):
                raise NotReadyError(f"The navigator did not start; see {log.name}.")
            yield
        finally:
            process.terminate()


class Demo:
    """The agent's work."""

    def __init__(self, agent: DemoAgent, screen: DemoScreen, colour: str) -> None:
        self._agent = agent
        self._screen = screen
        self._colour = colour
        self.is_zone_refused = False
        self.base: PlanarPose | None = None
        self.arm = Work(robot=ARM, task=f"pick up the {colour} cube")

    async def start_base(self) -> str:
        """Start the base alone."""
        await self._agent.call("start_all", {"robot": BASE})
        return ""

    async def start_arm(self) -> str:
        """Park the base, then start every module of the arm."""
        await self._agent.call("stop_all", {"robot": BASE})
        await self._agent.call("start_all", {"robot": ARM})
        return "the base is parked"

    async def ask_for_the_zone(self) -> str:
        """Request a place in the zone; return the gate's answer."""
        try:
            await self._drive(*STAIRS_M, 0.0)
        except NotReadyError as refusal:
            self.is_zone_refused = "zone 'stairs'" in str(refusal)
            return str(refusal)
        return "it was driven there"

    async def drive_to_table(self) -> str:
        """Navigate the base; return its distance from the table according to the simulator."""
        await self._drive(TABLE.x_m, TABLE.y_m, TABLE.yaw_rad)
        await anyio.sleep(REST_S)
        self.base = true_pose(await self._agent.call("get_status", {"robot": BASE}))
        if self.base is None:
            return "the simulator tells no pose"
        off_m = math.dist((self.base.x_m, self.base.y_m), (TABLE.x_m, TABLE.y_m))
        return f"{off_m * 100:.1f} cm off"

    async def _drive(self, x_m: float, y_m: float, yaw_rad: float) -> None:
        goal = pose_goal(x_m, y_m, yaw_rad)
        arguments = {"robot": BASE, "goal": goal, "server_timeout_s": 30.0}
        await self._agent.call("send_drive_to_goal", arguments)

    async def pick(self) -> str:
        """Run one task of the arm; return its end."""
        arguments = {"robot": ARM, "instruction": self.arm.task, "until": lifted(self._colour)}
        limits = {"max_s": ATTEMPT_S, "max_attempts": ATTEMPTS, "on_end": "hold"}
        end = await self._agent.call("run_task", {**arguments, **limits})
        self.arm.told = f"{end['outcome']}, attempt {end['attempts']}"
        with anyio.move_on_after(HELD_S):
            while not self._is_held():
                self.arm.status = await self._agent.call("get_status", {"robot": ARM})
                await anyio.sleep(0.2)
        judge_arm(self.arm, self._colour)
        return self.arm.told

    def _is_held(self) -> bool:
        return any(
            thing.name == self._colour and thing.held_s >= HOLD_GOAL_S
            for thing in simulated_objects(self.arm.status)
        )

    def print_verdicts(self, console: Console) -> bool:
        """Print the judges' verdicts; return whether all say yes."""
        verdicts = {
            "the zone was refused": self.is_zone_refused,
            f"base at the table: {self.base}": is_at_table(self.base),
            f"arm: {self.arm.truth}": self.arm.is_done,
        }
        table = Table("simulator says", "done", title="Judged", title_justify="left")
        for text, is_done in verdicts.items():
            table.add_row(text, "[green]yes[/]" if is_done else "[red]no[/]")
        console.print(table)
        return all(verdicts.values())


async def play(seed: int, colour: str, output: Path, console: Console, pace: MachinePace) -> bool:
    """Run the demo; return whether every judge says yes."""
    screen = DemoScreen(console)
    text = (HERE / "demo_nav.toml").read_text(encoding="utf-8")
    path = output / "roboneuron.toml"
    path.write_text(text + f"\n[robots.arm.plugins.fr3]\nseed = {seed}\nstate_rate_hz = 15.0\n")
    console.print(
        Panel(f"drive to the table, pick up the {colour} cube (scene {seed})", title="RoboNeuron")
    )
    begun_s = time.monotonic()
    with anyio.fail_after(WHOLE_S):
        async with spawned_server(["--config", str(path)], output / "server.log") as client:
            demo = Demo(DemoAgent(client, pace), screen, colour)
            for step, act in (
                ("start the base", demo.start_base),
                ("ask for a place on the stairs", demo.ask_for_the_zone),
                ("drive to the table", demo.drive_to_table),
                ("start the arm", demo.start_arm),
                (f"pick up the {colour} cube", demo.pick),
            ):
                with screen.step(step) as told:
                    told += filter(None, [await act()])
    is_done = demo.print_verdicts(console)
    console.print(f"  {time.monotonic() - begun_s:.0f} s; logs in {output}", highlight=False)
    return is_done


def main() -> int:
    """Parse the options, run the demo, report success."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--seed", type=int, default=7, help="scene of the arm")
    parser.add_argument("--colour", choices=COLOURS, default="red", help="of the cube")
    parser.add_argument("--output", type=Path, default=Path("out/demo-nav"))
    chosen = parser.parse_args()
    chosen.output.mkdir(parents=True, exist_ok=True)
    status = 1
    try:
        console = Console(highlight=False)
        with navigator(chosen.output):
            status = run_paced(
                lambda pace: play(chosen.seed, chosen.colour, chosen.output, console, pace)
            )
    except* RoboNeuronError as group:
        print(*(f"demo-nav: {error}" for error in leaves_of(group)), sep="\n", file=sys.stderr)
    except* TimeoutError:
        print(f"demo-nav: it was not over after {WHOLE_S:g} s.", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
