"""Lose a module during each kind of motion: the call ends with its name, and nothing moves again.

    python benchmarks/lost_modules.py --cell fr3 --folder /tmp/lost [--motions run_task]

Each trial asks for a motion, waits until a joint moves, and then kills (SIGKILL), freezes
(SIGSTOP), or freezes and resumes (SIGCONT after 0.1 s) a module. The call has to end within
`ENDS_S` of that, with the module's name; a process that is still frozen is then resumed, and for a
second no joint may move by more than `MOVED_RAD`. In a fleet, the other robot's task has to go on
meanwhile. --load runs busy processes beside it; --quiet-trials counts motions that end though no
module was lost.

Results are lines in FOLDER/CELL.jsonl; an interrupted run is resumed from them. Exit status 1 if a
trial has a problem.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lost_cell import KINDS, PLACES, Cell, served

ENDS_S = 3.0
"""The frozen state counts after 0.3 s, a silence after `server_timeout_s`; the arm is braked."""
MOVES_S = 60.0
"""A policy on a busy machine."""
MOVED_RAD = 0.02
AGAIN_S = 5.2
"""Within 5 s the same fault is recorded once."""
BRAKED_S = 0.5
"""A simulation that was frozen in motion brakes when it goes on."""
NEVER = {"kind": "tcp_in", "lower_m": [9, 9, 9], "upper_m": [10, 10, 10]}
HELD = {
    "kind": "held",
    "for_s": 1.0,
    "of": {"kind": "gripper_holds", "least_open": 0.15, "most_open": 0.85},
}
LOADING = "import time\nwhile True: sum(range(100000))"
WAYS = ("killed", "frozen", "frozen and resumed")


@contextlib.contextmanager
def loaded(processes: int) -> Iterator[None]:
    """Run processes that use a whole core each."""
    busy = [subprocess.Popen([sys.executable, "-S", "-c", LOADING]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait(10)


def run_task(cell: Cell, joint: str) -> Any:
    """A task that does not succeed."""
    told = "hand over the red cube" if joint.startswith("left") else "pick up the red cube"
    return cell.ask("run_task", instruction=told, until=NEVER, max_s=25)


def turn(cell: Cell, joint: str) -> float:
    """Target of a long turn of a joint."""
    state = cell.do("read_joint_states")["messages"][0]
    position = state["position"][state["name"].index(joint)]
    return 2.0 if position < 0 else -2.0


def move_joints(cell: Cell, joint: str) -> Any:
    """A turn of 8 s."""
    return cell.ask("move_joints", positions={joint: turn(cell, joint)}, duration_s=8.0)


def publish(cell: Cell, joint: str) -> Any:
    """A trajectory of 8 s."""
    point = {"positions": [turn(cell, joint)], "time_from_start": {"sec": 8, "nanosec": 0}}
    message = {"joint_names": [joint], "points": [point]}
    return cell.ask("publish_joint_trajectory", message=message)


def sequence(cell: Cell, joint: str) -> Any:
    """Two trajectories of 4 s, one after the other."""
    to = turn(cell, joint)
    steps = [
        {
            "message": {
                "joint_names": [joint],
                "points": [{"positions": [at], "time_from_start": {"sec": 4, "nanosec": 0}}],
            }
        }
        for at in (to / 2, to)
    ]
    return cell.ask("publish_joint_trajectory_sequence", steps=steps)


def goal(cell: Cell, joint: str) -> Any:
    """A goal of 8 s of the action of ros2_control."""
    state = cell.do("read_joint_states")["messages"][0]
    joints = {
        name: position
        for name, position in zip(state["name"], state["position"], strict=True)
        if "_joint" in name and "finger" not in name
    }
    joints[joint] = turn(cell, joint)
    point = {"positions": [*joints.values()], "time_from_start": 8.0}
    trajectory = {"joint_names": [*joints], "points": [point]}
    return cell.ask("send_follow_goal", goal={"trajectory": trajectory}, server_timeout_s=30.0)


def place(cell: Cell, joint: str) -> Any:
    """The held cube goes to the other side."""
    return cell.ask("place", dy_m=0.3)


def hold_cube(cell: Cell) -> None:
    """The hand holds the red cube, in a new simulation."""
    cell.do("stop_all")
    cell.run(*KINDS)
    answer = cell.ask("run_task", instruction="pick up the red cube", until=HELD, max_s=60)
    if "'outcome': 'succeeded'" not in str(answer.structured_content):
        raise RuntimeError(f"the cube is not held: {answer.structured_content}")
    cell.do("stop_inference")


def move_ee(cell: Cell, joint: str) -> Any:
    """A slow line there or back."""
    arm = {"arm": "left"} if joint.startswith("left") else {}
    state = cell.do("read_joint_states")["messages"][0]
    up = state["position"][state["name"].index(joint.replace("joint7", "joint4"))] < -1.9
    return cell.ask("move_ee", **arm, dz_m=0.18 if up else -0.18, duration_s=6.0)


def move_to_posture(cell: Cell, joint: str) -> Any:
    """The posture that is farther away."""
    return cell.ask("move_to", name="turned" if turn(cell, joint) > 0 else "returned")


def move_to_place(cell: Cell, joint: str) -> Any:
    """The place that is farther away."""
    first = joint.replace("joint7", "joint1")
    return cell.ask("move_to", name="there" if turn(cell, first) > 0 else "back")


MOTIONS: dict[str, Callable[[Cell, str], Any]] = {
    "run_task": run_task,
    "move_joints": move_joints,
    "move_ee": move_ee,
    "move_to place": move_to_place,
    "move_to posture": move_to_posture,
    "publish": publish,
    "sequence": sequence,
    "place": place,
    "goal": goal,
    "lead": lambda cell, joint: cell.ask("lead_arm", source="push"),
}


MOTIONS_OF = {
    "fr3": [one for one in MOTIONS if one != "goal"],
    # a twist names no arm
    "pair": [one for one in MOTIONS if one not in ("goal", "lead", "place")],
    "fleet": ["run_task"],
    "ros2": ["goal", "move_joints", "publish", "sequence"],
}


def lose(process: int, way: str) -> None:
    """Lose a process in this way."""
    os.kill(process, signal.SIGKILL if way == "killed" else signal.SIGSTOP)
    if way == "frozen and resumed":
        time.sleep(0.1)
        os.kill(process, signal.SIGCONT)


def trial(
    cell: Cell, motion: str, kind: str, way: str, joint: str, others: Sequence[Any] = ()
) -> dict[str, Any]:
    """One motion and its loss."""
    problems: list[str] = []
    result: dict[str, Any] = {"motion": motion, "module": kind, "way": way, "problems": problems}
    if motion == "place":
        hold_cube(cell)
    cell.run("robot", "control", *(("perception", "inference") if motion == "run_task" else ()))
    pid = int(cell.modules()[kind]["pid"])
    if motion == "lead":
        time.sleep(AGAIN_S)
    before = leads_lost(cell)
    answers: list[Any] = []
    ended_s: list[float] = []

    def call() -> None:
        answers.append(MOTIONS[motion](cell, joint))
        ended_s.append(time.monotonic())

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    deadline_s = time.monotonic() + MOVES_S
    while not cell.witness.moves():
        if time.monotonic() > deadline_s or (answers and motion != "lead"):
            return result | {"hindered": f"nothing moved: {answers}"[:400]}
        time.sleep(0.01)
    time.sleep(0.1)
    lost_s = time.monotonic()
    lose(pid, way)
    try:
        if motion == "lead":
            text = lead_end(cell, before, lost_s)
            ended_s[:] = [time.monotonic()]
        else:
            thread.join(ENDS_S + 30.0)
            if not answers:
                return result | {"problems": ["the call does not end"]}
            answer = answers[0]
            text = str(answer.structured_content or "") + str(answer.content)
            if motion == "run_task" and "'outcome': 'stopped'" not in text:
                problems.append("the outcome is not stopped")
        took_s = ended_s[0] - lost_s
        result["is_late"] = took_s > ENDS_S
        words = "has ended by itself" if way == "killed" else "frozen"
        if kind not in text or words not in text:
            problems.append(f"not named: {text[:300]}")
        result |= {"took_s": round(took_s, 2), "text": text[:600]}
        time.sleep(0.5)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    since_s = time.monotonic() + BRAKED_S
    time.sleep(BRAKED_S + 1.0)  # time in which nothing should happen
    moved_rad = cell.witness.moved_rad(since_s)
    result["moved_rad"] = round(moved_rad, 4)
    if moved_rad > MOVED_RAD:
        problems.append(f"moved by {moved_rad:.3f} rad afterwards")
    if others and "'outcome': 'stopped'" in str(others[-1].structured_content):
        problems.append(f"the other robot's task was stopped: {others[-1].content}"[:300])
    thread.join(10.0)
    return result


def leads_lost(cell: Cell) -> set[str]:
    """What is told of leads that were lost."""
    incidents = cell.do("list_incidents", entries=50)["incidents"]
    return {str(incident) for incident in incidents if incident["what"] == "lead_lost"}


def lead_end(cell: Cell, before: set[str], lost_s: float) -> str:
    """What is told of this lead's end."""
    deadline_s = lost_s + 30.0
    while time.monotonic() < deadline_s:
        if told := leads_lost(cell) - before:
            return told.pop()
        time.sleep(0.05)
    return "the lead goes on"


def trials(cell: str) -> list[tuple[str, str, str]]:
    """Motion, module and way of every trial."""
    motions = MOTIONS_OF[cell]
    return [
        (motion, kind, way)
        for motion in motions
        for kind in (KINDS if motion == "run_task" else ("robot", "control"))
        for way in WAYS
        # so short a loss of pictures ends nothing: they move nothing by themselves
        if (kind, way) != ("perception", "frozen and resumed")
    ]


def quiet(cell: Cell, joint: str, count: int) -> list[str]:
    """Motions and tasks without a loss; returns those that were ended."""
    ended = []
    for number in range(count):
        motion = ("run_task", "move_joints")[number % 2]
        cell.run("robot", "control", *(("perception", "inference") if number % 2 == 0 else ()))
        answer = MOTIONS[motion](cell, joint)
        text = str(answer.structured_content or "") + str(answer.content)
        if "frozen" in text or "has not reported" in text or "'stopped'" in text:
            ended.append(text[:400])
        print(f"{number + 1} {motion}: {len(ended)} were ended", flush=True)
    return ended


def main() -> int:
    """Run, or resume."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cell", choices=tuple(MOTIONS_OF), default="fr3")
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--motions", nargs="*", choices=tuple(MOTIONS), default=tuple(MOTIONS))
    parser.add_argument("--modules", nargs="*", choices=KINDS, default=KINDS)
    parser.add_argument("--ways", nargs="*", choices=WAYS, default=WAYS)
    parser.add_argument("--load", type=int, default=0, help="busy processes beside it")
    parser.add_argument("--quiet-trials", type=int, default=0, help="motions without a loss")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    ledger = arguments.folder / f"{arguments.cell}.jsonl"
    known = [json.loads(line) for line in ledger.open()] if ledger.exists() else []
    done = {(line["motion"], line["module"], line["way"]) for line in known}
    joint = PLACES.get(arguments.cell, PLACES["fr3"])[2]
    missing = [one for one in trials(arguments.cell) if one not in done]
    chosen = (arguments.motions, arguments.modules, arguments.ways)
    missing = [
        one
        for one in missing
        if all(part in among for part, among in zip(one, chosen, strict=True))
    ]
    with served(arguments.folder / arguments.cell, arguments.cell) as (cell, other):
        cell.run(*(KINDS if arguments.cell != "ros2" else ("robot", "control")))
        others: list[Any] = []

        def task_beside(robot: Cell) -> None:
            others.append(run_task(robot, joint))

        if arguments.quiet_trials:
            with loaded(arguments.load):
                ended = quiet(cell, joint, arguments.quiet_trials)
            print(f"{arguments.quiet_trials} motions without a loss, {len(ended)} ended: {ended}")
            return int(bool(ended))
        for motion, kind, way in missing:
            if other is not None:
                other.run(*KINDS)
                if not other.witness.moves():
                    threading.Thread(target=task_beside, args=(other,), daemon=True).start()
            with loaded(arguments.load):
                result = trial(cell, motion, kind, way, joint, others)
            known.append(result)
            with ledger.open("a") as file:
                file.write(json.dumps(result) + "\n")
            print(json.dumps({k: v for k, v in result.items() if k != "text"}), flush=True)
    bad = [line for line in known if line["problems"] or line.get("is_late")]
    hindered = sum("hindered" in line for line in known)
    longest_s = max((line.get("took_s", 0.0) for line in known), default=0.0)
    print(
        f"{arguments.cell}: {len(known)} trials, {len(bad)} with a problem, {hindered} hindered, "
        f"slowest end {longest_s:.2f} s"
    )
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
