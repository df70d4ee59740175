"""Hang the interpreter of each process of a served arm, and tell it something meanwhile.

    python benchmarks/hang_matrix.py --folder /tmp/hang [--processes control] [--phases start]

A thread of the process calls `sleep` of the C library with the interpreter's lock
(`ctypes.PyDLL(None).sleep`), while a task moves the arm ("motion") or while the process starts
("start"). It then gets nothing, SIGTERM, SIGINT or SIGUSR1, or its stdin or its parent ends, or
`roboneuron estop` stops the arm (in motion; within `STOPPED_S` if the server hangs). The arm must
rest within `REST_S`, the process and all that it has started must be gone within `ENDED_S`, latch
and audit must be whole, the status must name the hang, and the next start must
work. The bound on a hang is `BOUND_S` here, and three times as long while something loads.

Results are lines in FOLDER/hang.jsonl; an interrupted run is resumed from them; the table of all
cells is printed at the end. Exit status 1 if a cell has a problem.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
from hang_arm import Arm
from hang_lone import lone_trial
from hang_parts import BOUND_S, CONFIG, HOOK, PROCESSES, TOLD, Hangs
from lost_cell import KINDS

from rn_testing.domain import free_ros_domain
from roboneuron.hang_watch import END_SIGNAL
from roboneuron.ros.environment import prepare_environment


@contextlib.contextmanager
def arm_of(folder: Path, hangs: Hangs, environment: dict[str, str]) -> Iterator[Arm]:
    """An arm, made when it is needed."""
    arm = Arm(folder, hangs, environment)
    try:
        yield arm
    finally:
        arm.end()
        arm.link.close()


def table(lines: list[dict[str, Any]]) -> str:
    """Seconds until the process had ended / until the arm was at rest, by cell."""
    rows = [f"{'process':14}{'phase':8}" + "".join(f"{told:>16}" for told in TOLD)]
    for process in PROCESSES:
        for phase in ("motion", "start"):
            cells = {x["told"]: x for x in lines if (x["process"], x["phase"]) == (process, phase)}
            texts = []
            for told in TOLD:
                cell = cells.get(told)
                text = "-" if cell is None else f"{cell.get('ended_s', '?')}"
                text += f" / {cell['rest_s']}" if cell is not None and "rest_s" in cell else ""
                texts.append(text + ("" if cell is None or not cell["problems"] else " BAD"))
            rows.append(f"{process:14}{phase:8}" + "".join(f"{text:>16}" for text in texts))
    return "\n".join(rows)


def is_tried(process: str, phase: str, told: str) -> bool:
    """False for a stop of what moves no arm."""
    return told != "estop" or (phase == "motion" and process in ("server", *KINDS))


def main() -> int:
    """Run, or resume."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--processes", nargs="*", choices=PROCESSES, default=PROCESSES)
    parser.add_argument(
        "--phases", nargs="*", choices=("motion", "start"), default=("motion", "start")
    )
    parser.add_argument("--told", nargs="*", choices=TOLD, default=TOLD)
    arguments = parser.parse_args()
    folder = arguments.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "roboneuron.toml").write_text(CONFIG.format(folder=folder, bound=BOUND_S))
    (folder / "hook").mkdir(exist_ok=True)
    (folder / "hook" / "sitecustomize.py").write_text(HOOK)
    hangs = Hangs(folder)
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    prepare_environment(folder / "log")
    environment = {
        **os.environ,
        "HANG_FOLDER": str(hangs.folder),
        "PYTHONPATH": str(folder / "hook"),
    }
    environment.pop("ROBONEURON_RECORDER", None)
    ledger = folder / "hang.jsonl"
    known = [json.loads(line) for line in ledger.open()] if ledger.exists() else []
    done = {(line["process"], line["phase"], line["told"]) for line in known}
    with arm_of(folder, hangs, environment) as arm:
        for process in arguments.processes:
            for phase in arguments.phases:
                for told in arguments.told:
                    if (process, phase, told) in done or not is_tried(process, phase, told):
                        continue
                    try:
                        if process in ("server", "recorder", *KINDS):
                            result = arm.trial(process, phase, told)
                        else:
                            result = lone_trial(folder, hangs, environment, process, phase, told)
                    except (RuntimeError, TimeoutError, OSError, psutil.Error) as error:
                        arm.end()
                        result = {"process": process, "phase": phase, "told": told}
                        result["problems"] = [f"not tried: {type(error).__name__}: {error}"]
                    known.append(result)
                    with ledger.open("a") as file:
                        file.write(json.dumps(result) + "\n")
                    print(json.dumps(result), flush=True)
    print(table(known))
    bad = [line for line in known if line["problems"]]
    print(f"{len(known)} cells, {len(bad)} with a problem; END_SIGNAL is {int(END_SIGNAL)}")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
