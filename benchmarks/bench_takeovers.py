"""A scripted person takes over a running policy at random times, or disconnects during a motion.

    python benchmarks/bench_takeovers.py takeovers --trials 200 [--minutes 4] [--browser 10]
    python benchmarks/bench_takeovers.py lost --trials 100 [--minutes 4]
    python benchmarks/bench_takeovers.py report

A server whose simulated FR3 follows the servo policy; the person uses the page's websocket (or, in
the first --browser trials, its keys in a headless Chromium), in a separate process. Every fourth
trial gives a new instruction. Each waits for a random time, takes over (a third blended), drives,
and hands back, half of the time while the arm moves; or the page is closed, stops sending with its
connection open (SIGSTOP), is killed, or its switch is released. A separate node evaluates: see
takeover_judge.py, and command_judge.py for the commands. A hand-over is compared with the
undisturbed policy of the same trial. The ledger --out is continued; a trial's seed determines the
person's actions.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from command_judge import in_order, judged, largest, noted
from page_cell import PageCell, served
from plugin_site import installed
from takeover_judge import REST_S, WAYS, WINDOW_S, Onlooker, faults_of, report
from takeover_page import PageProcess

from rn_robot_fr3.profile import profile as fr3_profile
from roboneuron.ros.environment import prepare_environment

sys.path.pop(0)

CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "servo"
[control]
controller = "urdf"
[view]
enabled = true
port = 0
[supervisor]
state_directory = "{state}"
[plugins.fr3]
seed = {seed}
"""
COLOURS = ("red", "green", "blue")
NOTES = "limited.jsonl"
"""See takeover_plugin.py."""
EACH = 20
"""Trials with one server; a seed determines the cubes' positions."""
PER_EPISODE = 4
"""Number of takeovers for one instruction."""
WATCHED_S = 1.8
"""Observation time after a page is lost; a lead without messages ends after 1 s."""
OUT = Path("out/takeovers.jsonl")


class Cell(PageCell):
    """A server with its page, its agent, and the observer."""

    def __init__(self, folder: Path, seed: int, stack: ExitStack) -> None:
        super().__init__(folder, CONFIG.format(state=folder / "state", seed=seed), stack)
        limits = fr3_profile().limits
        assert limits is not None
        self._limits, self._notes = limits, folder / "state" / NOTES
        self.seen = Onlooker("fr3", limits, stack)

    def sent(self, since_ns: int, spans: dict[str, tuple[int, int]]) -> dict[str, Any]:
        """What control has commanded within spans of a trial that began at `since_ns`."""
        messages = [one for one in list(self.seen.commands) if one.at_ns >= since_ns]
        # a note is a little earlier than its message
        notes = noted(self._notes, since_ns - 1_000_000_000)
        commands, unknown = in_order(notes, messages)
        found = judged(commands, self._limits)
        values = {name: largest(found, *span) for name, span in spans.items()}
        told = {name: None if one is None else asdict(one) for name, one in values.items()}
        return {"sent": told, "unknown": unknown}

    def commanded_s(self, since_ns: int, until_ns: int) -> float:
        """Time from `since_ns` to the end of the last command that began before `until_ns` [s]."""
        ends_ns = [
            note.at_ns + round(note.duration_s * 1e9)
            for note in noted(self._notes, since_ns - 1_000_000_000)
            if note.at_ns <= until_ns
        ]
        return max(0.0, (max(ends_ns, default=since_ns) - since_ns) / 1e9)

    def needs_start(self) -> str:
        """Reason why control prevents motion; empty for none."""
        modules = self.do("get_status")["modules"]
        return str(next(one for one in modules if one["module"] == "control").get("needs_start"))

    def follow_policy(self, draw: random.Random, *, is_new: bool) -> None:
        """Return at a random time at which the policy moves the arm; a new instruction is given if
        `is_new`, or if the last one is completed. If four do not make it move, the arm is sent home
        first.
        """
        for tries in range(8):
            if tries == 4:
                self._go_home()
            if is_new or tries:
                self._instruct(f"pick up the {draw.choice(COLOURS)} cube")
                time.sleep(1.0)
            time.sleep(draw.uniform(0.3, 1.8))
            now_ns = time.time_ns()
            acted = self.seen.who(now_ns - 300_000_000, now_ns)
            if acted == {"policy"} and self.seen.moves(now_ns - 300_000_000):
                return
        raise RuntimeError("The policy does not move the arm.")

    def _go_home(self) -> None:
        """Move the arm out of a posture that the policy cannot leave, such as a singularity to
        which the person has led it.
        """
        self.do("take_over")
        with suppress(RuntimeError):  # it may have stopped already
            self.do("stop_inference")
        self.do("move_to", name="home")

    def _instruct(self, text: str) -> None:
        self.do("take_over")
        modules = self.do("get_status")["modules"]
        inference = next(one for one in modules if one["module"] == "inference")
        start = inference["phase"] != "running"
        with suppress(RuntimeError):  # if the cube is not visible, another colour is tried
            self.do("start_inference" if start else "set_instruction", instruction=text)


def driven(draw: random.Random) -> list[float]:
    """A plausible twist in the base frame, upwards more than downwards [m/s, rad/s]."""
    linear = [draw.uniform(-0.2, 0.2), draw.uniform(-0.2, 0.2), draw.uniform(-0.03, 0.2)]
    return [*linear, *([0.0] * 3 if draw.random() < 0.5 else [draw.uniform(-0.5, 0.5)] * 3)]


def take_over(
    cell: Cell, page: PageProcess, draw: random.Random, *, is_new: bool
) -> dict[str, Any]:
    """One takeover, in a new or the running episode; returns the row of the ledger."""
    mode = "blend" if draw.random() < 1 / 3 else "person"
    begun_ns = time.time_ns()
    cell.follow_policy(draw, is_new=is_new)
    led = page.do("lead", mode=mode, scale=draw.choice((0.5, 1.0)))
    if led["text"]:
        raise RuntimeError(led["text"])
    page.do("drive", twist=[0.0] * 6, held=False)
    time.sleep(0.12)
    for _ in range(draw.choice((1, 1, 2))):
        page.do("drive", twist=driven(draw), held=True)
        time.sleep(draw.uniform(0.3, 1.0))
    is_moving = draw.random() < 0.5
    if not is_moving:
        page.do("drive", twist=[0.0] * 6, held=False)
        time.sleep(0.3)
    asked_ns = time.time_ns()
    back = page.do("back")
    deadline_s = time.monotonic() + 6.0
    while cell.seen.went_on_s(asked_ns) is None and time.monotonic() < deadline_s:
        time.sleep(0.02)
    went_on = cell.seen.went_on_s(asked_ns)
    time.sleep(WINDOW_S + 0.1)
    seen, window_ns, end_ns = cell.seen, round(WINDOW_S * 1e9), time.time_ns()
    after_ns = asked_ns if went_on is None else asked_ns + round(went_on[0] * 1e9)
    alone = seen.windows(begun_ns, led["begun_ns"])
    spans = {
        "taken": (led["begun_ns"], led["done_ns"] + window_ns),
        "back": (asked_ns, after_ns + window_ns),
        "all": (led["begun_ns"], end_ns),
    }
    motions = {name: seen.motion(*span) for name, span in spans.items()}
    sent = cell.sent(begun_ns, {"alone": (begun_ns, led["begun_ns"]), **spans})
    # the release itself comes up to a period before the page is answered
    inside = seen.who(led["done_ns"] + 100_000_000, asked_ns)
    return {
        "mode": mode,
        "moving": is_moving,
        "refused": back["text"],
        "who": sorted(inside),
        "went_on": went_on,
        "held_up_s": seen.held_up_s(*spans["all"]),
        "alone": [asdict(motion) for motion in alone],
        **sent,
        **{name: None if one is None else asdict(one) for name, one in motions.items()},
    }


def lose(
    cell: Cell, page: PageProcess, way: str, draw: random.Random, spare: Callable[[], object]
) -> dict[str, Any]:
    """Lose the page during a motion; returns the row of the ledger. `spare` opens the next page,
    once the arm should be at rest.
    """
    begun_ns = time.time_ns()
    cell.follow_policy(draw, is_new=True)
    for _ in range(4):
        if text := page.do("lead", mode="person", scale=1.0)["text"]:
            raise RuntimeError(text)
        page.do("drive", twist=[0.0] * 6, held=False)
        time.sleep(0.12)
        twist = driven(draw)
        page.do("drive", twist=twist, held=True)
        time.sleep(draw.uniform(0.3, 0.8))
        if cell.seen.moves(time.time_ns() - 60_000_000):
            break
        page.do("back")
    else:
        raise RuntimeError("The arm does not follow.")
    if way == "released":
        lost_ns = int(page.do("drive", twist=twist, held=False)["begun_ns"])
    else:
        if way == "closed":
            page.do("close")
        else:
            os.kill(page.process.pid, signal.SIGSTOP if way == "silent" else signal.SIGKILL)
        lost_ns = page.sampled_ns()
    time.sleep(2.0 * REST_S)
    if way != "released":
        spare()
    time.sleep(WATCHED_S - 2.0 * REST_S)
    end_ns = time.time_ns()
    rest_s = cell.seen.rest_s(lost_ns, end_ns)
    motion = cell.seen.motion(lost_ns, end_ns)
    sent = cell.sent(begun_ns, {"all": (begun_ns, end_ns)})
    told = "" if way == "released" else cell.needs_start()
    goes_on = False
    if way == "released":
        page.do("drive", twist=[0.0, 0.0, 0.1, 0.0, 0.0, 0.0], held=True)
        time.sleep(0.4)
        goes_on = cell.seen.moves(time.time_ns() - 200_000_000)
        page.do("back")
    return {
        "way": way,
        "lost_ns": lost_ns,
        "rest_s": rest_s,
        "late_motion": cell.seen.late_motion(lost_ns, end_ns),
        "commanded_s": cell.commanded_s(lost_ns, end_ns),
        "held_up_s": cell.seen.held_up_s(lost_ns, lost_ns + round(2.0 * REST_S * 1e9)),
        "needs_start": told,
        **sent,
        "goes_on": goes_on,
        "all": None if motion is None else asdict(motion),
    }


def play(arguments: argparse.Namespace, rows: list[dict[str, Any]], folder: Path) -> None:
    """Run trials with one server, each written to the ledger at once."""
    part, done = arguments.part, sum(row["part"] == arguments.part for row in rows)
    end_s = time.monotonic() + 60.0 * arguments.minutes
    chromium = shutil.which("chromium") or ""
    place = folder / f"{part}-{done}"
    with served(place, partial(Cell, place, done)) as cell, ExitStack() as stack:
        pages: list[PageProcess] = []

        def opened(browser: str = "") -> None:
            pages.append(PageProcess(cell.url, folder, browser))
            stack.callback(pages[-1].end)

        for number in range(done, min(done + EACH, arguments.trials)):
            if time.monotonic() > end_s:
                break
            browser = chromium if part == "takeovers" and number < arguments.browser else ""
            draw, begun_s = random.Random(number), time.monotonic()
            row: dict[str, Any] = {"part": part, "seed": number, "browser": bool(browser)}
            try:
                if not pages:
                    opened(browser)
                page = pages[0]
                page.ready()
                if part == "lost":
                    row |= lose(cell, page, WAYS[number % len(WAYS)], draw, opened)
                else:
                    is_new = (number - done) % PER_EPISODE == 0
                    row |= take_over(cell, page, draw, is_new=is_new)
            except (RuntimeError, TimeoutError, OSError) as error:
                row |= {"broken": str(error)[:300]}
            is_last = number + 1 == arguments.browser
            if row.get("broken") or row.get("way", "released") != "released" or is_last:
                for page in pages[:1]:
                    page.end()
                del pages[:1]
            rows.append(row | {"load": os.getloadavg()[0], "took_s": time.monotonic() - begun_s})
            with arguments.out.open("a") as lines:
                lines.write(json.dumps(rows[-1]) + "\n")
            told = row.get("broken") or "; ".join(faults_of(row)) or "ok"
            print(f"{part} {number}: {row.get('mode') or row.get('way')}: {told}", flush=True)


def main() -> int:
    """Run trials until there are enough or the time is over, then report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("part", choices=("takeovers", "lost", "report"))
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=1e6, help="of this call; then go on later")
    parser.add_argument("--browser", type=int, default=0, help="so many of the first takeovers")
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    if arguments.out.exists():
        rows = [json.loads(line) for line in arguments.out.read_text().splitlines()]
    end_s = time.monotonic() + 60.0 * arguments.minutes
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        prepare_environment(Path(name) / "log")
        stack.enter_context(installed(Path(name), "takeover-notes", ("takeover_plugin",)))
        while arguments.part != "report" and time.monotonic() < end_s:
            if sum(row["part"] == arguments.part for row in rows) >= arguments.trials:
                break
            play(arguments, rows, Path(name))
            arguments.minutes = (end_s - time.monotonic()) / 60.0
    return 0 if report(rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
