"""Kill or freeze a random process of a served arm during a random motion: the arm rests.

    python benchmarks/random_losses.py --folder /tmp/losses --trials 60

Each trial asks for a motion (run_task, move_joints, a published trajectory), waits until a joint
moves, and sends SIGKILL or SIGSTOP to the server, one of its modules, or the recorder. Without its
recorder the motion goes on. Otherwise the arm must rest within `REST_S`. What is frozen is resumed
after that, and for `WATCH_S` no joint may move; after the end of a server nothing may be left of
what it has started. Audit and latch must be whole, and the next start must work. The number of a
trial determines its motion, process and signal.

Results are lines in FOLDER/losses.jsonl; an interrupted run is resumed from them. Exit status 1 if
a trial has a problem.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import psutil
from hang_arm import Arm
from hang_parts import CONFIG, ENDED_S, NEVER, REST_S, Hangs, HungClient, alive, until, whole
from lost_cell import KINDS, STILL_RAD_S

from rn_testing.domain import free_ros_domain
from roboneuron.ros.environment import prepare_environment

PROCESSES = ("server", *KINDS, "recorder")
HANG_S = 15.0
"""The default of `supervisor.hang_timeout_s`."""
MOTIONS = ("run_task", "move_joints", "publish")
WAYS = {"killed": signal.SIGKILL, "frozen": signal.SIGSTOP}
JOINT = "fr3_joint7"
WATCH_S = 2.0
MOVED_RAD = 0.02
"""A joint sags by less than 0.002 rad."""
BRAKED_S = 0.5
"""A simulation that was frozen in motion brakes when it goes on."""


def move(arm: Arm, client: HungClient, motion: str) -> None:
    """Ask for a motion, and return while the arm moves."""
    client.run_all()
    until(lambda: arm.witness.states, 10.0, "a measurement")
    turned = 2.0 if arm.witness.states[-1][1][6] < 0 else -2.0
    calls: dict[str, tuple[str, dict[str, Any]]] = {
        "run_task": (
            "run_task",
            {"instruction": "pick up the red cube", "until": NEVER, "max_s": 60},
        ),
        "move_joints": ("move_joints", {"positions": {JOINT: turned}, "duration_s": 8.0}),
        "publish": (
            "publish_joint_trajectory",
            {
                "message": {
                    "joint_names": [JOINT],
                    "points": [
                        {"positions": [turned], "time_from_start": {"sec": 8, "nanosec": 0}}
                    ],
                }
            },
        ),
    }
    if motion != "run_task":
        client.ask("stop_inference")
    tool, arguments = calls[motion]

    def call() -> None:
        with contextlib.suppress(TimeoutError, OSError, ValueError):
            client.ask(tool, **arguments)

    threading.Thread(target=call, daemon=True).start()
    until(arm.witness.moves, 60.0, "a motion")
    time.sleep(random.uniform(0.1, 1.0))  # the loss comes at any time of the motion


def process_id(arm: Arm, client: HungClient, process: str) -> int:
    """The process that is lost."""
    if process == "server":
        return int(client.process.pid)
    if process == "recorder":
        return int(until(lambda: arm.child("rn_recorder_runs"), 30.0, "the recorder"))
    return int(client.modules()[process]["pid"])


def trial(arm: Arm, number: int) -> dict[str, Any]:
    """One motion, and one loss."""
    draw = random.Random(number)
    motion = draw.choice(MOTIONS)
    # a direct motion needs neither pictures nor a policy
    needless = () if motion == "run_task" else ("perception", "inference")
    process = draw.choice([one for one in PROCESSES if one not in needless])
    way = draw.choice(list(WAYS))
    random.seed(number)
    problems: list[str] = []
    result: dict[str, Any] = {"number": number, "motion": motion, "process": process, "way": way}
    client = arm.served()
    move(arm, client, motion)
    pid = process_id(arm, client, process)
    family = {pid} | (arm.children() if process == "server" else set())
    lost_s = time.monotonic()
    os.kill(pid, WAYS[way])
    time.sleep(REST_S + 0.5)
    if process != "recorder":
        result["rest_s"] = round(arm.last_motion_s(lost_s), 2)
        if result["rest_s"] > REST_S:
            problems.append(f"the arm moved for {result['rest_s']} s")
    if way == "frozen":
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    if process == "recorder":
        client.ask("emergency_stop", reason="the end of this trial")
        client.ask("reset_emergency_stop")
    since_s = time.monotonic() + BRAKED_S
    time.sleep(BRAKED_S + WATCH_S)  # time in which nothing should happen
    result["moved_rad"] = round(arm.witness.moved_rad(since_s), 4)
    if result["moved_rad"] > MOVED_RAD:
        problems.append(f"moved by {result['moved_rad']} rad afterwards")
    if process == "server" and way == "killed":
        try:
            until(lambda: not any(map(alive, family)), ENDED_S, "the end of what it has started")
        except TimeoutError as error:
            problems.append(f"{error}: {[one for one in family if alive(one)]}")
    problems += whole(arm.folder / "state")
    try:
        arm.served().run_all()
    except (RuntimeError, TimeoutError, OSError) as error:
        problems.append(f"the next start: {error}")
        arm.end()
    return result | {"problems": problems}


def main() -> int:
    """Run, or resume."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--trials", type=int, default=60)
    arguments = parser.parse_args()
    folder = arguments.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    config = (
        CONFIG.format(folder=folder, bound=HANG_S) + '[server]\nreset_emergency_stop = "client"\n'
    )
    (folder / "roboneuron.toml").write_text(config)
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    prepare_environment(folder / "log")
    environment = dict(os.environ)
    environment.pop("ROBONEURON_RECORDER", None)
    ledger = folder / "losses.jsonl"
    known = [json.loads(line) for line in ledger.open()] if ledger.exists() else []
    done = {line["number"] for line in known}
    arm = Arm(folder, Hangs(folder), environment)
    try:
        for number in range(arguments.trials):
            if number in done:
                continue
            try:
                result = trial(arm, number)
            except (RuntimeError, TimeoutError, OSError, psutil.Error) as error:
                arm.end()
                result = {"number": number, "hindered": f"{type(error).__name__}: {error}"}
                result["problems"] = []
            known.append(result)
            with ledger.open("a") as file:
                file.write(json.dumps(result) + "\n")
            print(json.dumps(result), flush=True)
    finally:
        arm.end()
        arm.link.close()
    bad = [line for line in known if line["problems"]]
    hindered = sum("hindered" in line for line in known)
    slowest_s = max((line.get("rest_s", 0.0) for line in known), default=0.0)
    farthest = max((line.get("moved_rad", 0.0) for line in known), default=0.0)
    lost = Counter(f"{line['process']} {line['way']}" for line in known if "process" in line)
    print(", ".join(f"{what} {count}" for what, count in sorted(lost.items())))
    print(
        f"{len(known)} trials, {len(bad)} with a problem, {hindered} hindered; at rest after at "
        f"most {slowest_s:.2f} s (still: below {STILL_RAD_S} rad/s), {farthest:.4f} rad afterwards"
    )
    return int(bool(bad) or hindered * 5 > len(known))


if __name__ == "__main__":
    sys.exit(main())
