"""Click the emergency stop of a page in a browser while a served, simulated FR3 moves, and measure
the stop at its joints.

Server, robot, browser and this observer are separate processes, as on a robot; all use this
machine's clock.
"""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from page_cell import PageCell, served

from roboneuron.estop import ESTOP_FILE

CONFIG = """
[robot]
name = "fr3"
driver = "simulated"
[supervisor]
state_directory = "{state}"
[view]
enabled = true
port = 0
"""
JOINT, PLACES_RAD, MOTION_S = "fr3_joint7", (-2.0, 2.2), 5.0
"""A long turn of the wrist that stays inside the workspace."""
FAST_RAD_S, STILL_RAD_S, STILL_S = 0.25, 0.02, 0.3
MOST_S = 60.0
PAGE_MS = 180_000
NOTE_CLICKS = "() => addEventListener('click', () => { window.clicked = Date.now() / 1000; }, true)"


@dataclass(frozen=True, kw_only=True, slots=True)
class Stop:
    """One click and the stop that it caused.

    Attributes:
        speed_rad_s: speed of the fastest joint at the click.
        file_ms: time from the click to the latch file.
        rest_ms: time from the click to the first joint state from which on no joint moves.
        way_rad: distance that JOINT moved after the click.
    """

    speed_rad_s: float
    file_ms: float
    rest_ms: float
    way_rad: float


class Cell(PageCell):
    """The served arm; times are wall-clock times [s]."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        from sensor_msgs.msg import JointState

        from roboneuron.ros.link import RosLink  # imported when the environment is prepared
        from roboneuron.ros.qos import NEWEST

        self._state = folder / "state"
        super().__init__(folder, CONFIG.format(state=self._state), stack, ("robot",))
        self.states: list[tuple[float, float, float]] = []
        """Time of arrival, speed of the fastest joint [rad/s] and position of JOINT [rad]."""
        self.link = RosLink("bench_witness")
        self.link.open()
        stack.callback(self.link.close)
        self.link.subscribe(JointState, "/fr3/joint_states", self._on_state, NEWEST)

    def _on_state(self, message: Any) -> None:
        speed = float(np.abs(message.velocity[:7]).max())
        self.states.append((time.time(), speed, message.position[message.name.index(JOINT)]))

    def begin_motion(self) -> None:
        """Turn the wrist to the farther place, and return once it is fast."""
        place = max(PLACES_RAD, key=lambda place: abs(place - self.states[-1][2]))
        arguments = {"positions": {JOINT: place}, "duration_s": MOTION_S}
        answer = self._portal.start_task_soon(self._client.call_tool, "move_joints", arguments)
        self.wait_until(
            lambda: self.states[-1][1] > FAST_RAD_S or answer.done(), "the arm does not move"
        )
        if answer.done():
            raise SystemExit(f"move_joints ended before it was fast: {answer.result(1.0).content}")

    def judge(self, clicked_s: float) -> Stop:
        """Measure the stop after a click; waits until the joints are at rest."""
        latch = self._state / ESTOP_FILE
        self.wait_until(latch.exists, "the stop was not latched")
        self.wait_until(lambda: self._rest_s(clicked_s) is not None, "the arm does not stop")
        rest_s = self._rest_s(clicked_s)
        assert rest_s is not None
        before = next(state for state in reversed(self.states) if state[0] <= clicked_s)
        return Stop(
            speed_rad_s=before[1],
            file_ms=(latch.stat().st_mtime - clicked_s) * 1e3,
            rest_ms=(rest_s - clicked_s) * 1e3,
            way_rad=abs(self.states[-1][2] - before[2]),
        )

    def release(self) -> None:
        """Reset the stop as a person does, with a "y" in a terminal."""
        person, terminal = pty.openpty()
        try:
            os.write(person, b"y\n")
            command = [
                sys.executable,
                "-m",
                "roboneuron.cli.main",
                "estop",
                "--reset",
                "--state",
                str(self._state),
            ]
            subprocess.run(command, stdin=terminal, check=True, timeout=MOST_S, capture_output=True)
        finally:
            os.close(person)
            os.close(terminal)

    def _rest_s(self, since_s: float) -> float | None:
        """Time at which the joints came to rest; None until they have rested for STILL_S."""
        rest_s = None
        for at_s, speed, _ in [state for state in self.states if state[0] > since_s]:
            rest_s = None if speed >= STILL_RAD_S else rest_s or at_s
        return rest_s if rest_s is not None and self.states[-1][0] - rest_s > STILL_S else None

    def wait_until(self, is_so: Callable[[], bool], failure: str) -> None:
        """Wait for a condition; ends the benchmark when it does not come true."""
        deadline_s = time.monotonic() + MOST_S
        while not is_so():
            if time.monotonic() > deadline_s:
                raise SystemExit(failure)
            time.sleep(0.005)


def measure_stops(browser: Any, folder: Path, clicks: int) -> list[Stop]:
    """Click `clicks` times, each while the arm moves."""
    stops = []
    with served(folder / "cell", partial(Cell, folder / "cell")) as cell:
        page = browser.new_page(viewport={"width": 700, "height": 500})
        page.set_default_timeout(PAGE_MS)
        page.goto(cell.url)
        page.get_by_text("Instruction:").wait_for(timeout=PAGE_MS)
        page.evaluate(NOTE_CLICKS)
        button = page.get_by_role("button", name="EMERGENCY STOP")
        for number in range(clicks):
            cell.states.clear()
            cell.wait_until(lambda: bool(cell.states), "the robot says nothing")
            page.get_by_text("emergency stop not pressed").wait_for(timeout=PAGE_MS)
            cell.begin_motion()
            button.click(force=True)
            stops.append(cell.judge(page.evaluate("() => window.clicked")))
            print(f"click {number + 1}: {stops[-1]}", file=sys.stderr, flush=True)
            page.get_by_text("EMERGENCY STOP LATCHED").wait_for(timeout=PAGE_MS)
            cell.release()
        page.close()
    return stops
