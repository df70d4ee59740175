"""A policy moves the FR3 through a strict control box that loses packets; each command is checked
against published limits.

    python benchmarks/bench_fci_box.py --minutes 60 [--loss 0,1,2,5] [--duplicate 0] [--reorder 0]
    [--delay 0]

A served FR3 (server, perception, policy at 20 Hz, control, robot) behind `fci_box` and
franka-sim. The losses [%] of both directions alternate every `TURN_S`. The commands that the arm
counts, extrapolated cycles included, are checked for velocity at their position, acceleration and
jerk. One line per turn is written to out/bench-fci/box/turns.jsonl; an interrupted run can be
resumed, `--judge` only prints, `--fresh` starts again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from fci_cell import FciCell, served_fci

OUT = Path("out/bench-fci/box")
TURN_S = 30.0
_LOOK_S = 0.25
STANDS_S = 6.0
"""The policy never stands this long by itself: on a busy machine modules end, and are restarted."""
SUMS = ("commands", "extrapolated", "violations", "late", "repeated", "states")
WORST = ("longest_gap", "worst_velocity", "worst_acceleration", "worst_jerk")


def turn(cell: FciCell, faults: dict[str, float], lasts_s: float) -> dict[str, Any]:
    """Let the policy continue for this time; returns the box's statistics."""
    assert cell.box is not None
    cell.box.tell(fresh=1, **faults)
    began_s, moving, looks, arm_faults = time.monotonic(), 0, 0, list[str]()
    restarts, still_since_s = 0, began_s
    end_s = began_s + lasts_s
    while time.monotonic() < end_s:
        time.sleep(_LOOK_S)
        looks += 1
        moving += cell.speed() > 0.02
        if fault := cell.fault():
            arm_faults.append(fault)
            with contextlib.suppress(RuntimeError):
                cell.agent.do("recover_robot")
            still_since_s = -STANDS_S
        if cell.speed() > 0.02:
            still_since_s = time.monotonic()
        elif time.monotonic() > still_since_s + STANDS_S:
            restart(cell)
            restarts += 1
            still_since_s = time.monotonic()
    seen = cell.box.tell()
    return {
        **faults,
        **{name: seen[name] for name in (*SUMS, *WORST, "beyond")},
        "lasts_s": time.monotonic() - began_s,
        "moving": moving / looks,
        "faults": arm_faults,
        "restarts": restarts,
        "load": os.getloadavg()[0],
    }


def restart(cell: FciCell) -> None:
    """Restart ended modules and the policy."""
    for step in (
        lambda: cell.start("robot", "perception", "control"),
        lambda: cell.agent.do("stop_inference"),
        lambda: cell.agent.do("start_inference", instruction="sway"),
    ):
        with contextlib.suppress(RuntimeError):
            step()


def report(rows: list[dict[str, Any]]) -> int:
    """Print rows of the table; returns the number of commands beyond a limit."""
    print(
        "| loss each way | time, moving | commands; cycles extrapolated; longest gap | beyond a "
        "limit |",
        end="",
    )
    print(" greatest share of the limit: velocity, acceleration, jerk | faults |")
    print("|---|---|---|---|---|---|")
    stood, rows = (
        [row for row in rows if row["moving"] == 0.0],
        [row for row in rows if row["moving"] > 0.0],
    )
    if not rows:
        print("nothing was measured")
        return 1
    for loss in sorted({row["loss"] for row in rows}):
        part = [row for row in rows if row["loss"] == loss]
        sums = {name: sum(row[name] for row in part) for name in SUMS}
        worst = {name: max(row[name] for row in part) for name in WORST}
        lasted_s = sum(row["lasts_s"] for row in part)
        moving = sum(row["moving"] * row["lasts_s"] for row in part) / lasted_s
        shares = ", ".join(f"{worst[name]:.0%}" for name in WORST[1:])
        print(
            f"| {loss:.0%} | {lasted_s / 60.0:.1f} min, {moving:.0%} | {sums['commands']}; "
            f"{sums['extrapolated']}; "
            f"{worst['longest_gap']} | {sums['violations']} | {shares} | "
            f"{sum(len(row['faults']) for row in part)} |"
        )
    for row in rows:
        for text in (*row["beyond"], *row["faults"]):
            print(f"    loss {row['loss']:.0%}: {text}")
    loads = [row["load"] for row in rows]
    repeated = sum(row["repeated"] for row in rows)
    load = f"load average {min(loads):.1f} to {max(loads):.1f} on {os.cpu_count()} cores"
    print(
        f"{repeated} commands repeated a number; {load}; {len(stood)} turns in which the policy "
        "stood are left out"
    )
    return sum(row["violations"] + row["repeated"] for row in rows)


def main() -> int:
    """Run the missing turns, print the table; 0 if nothing was beyond a limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--loss", default="0,1,2,5", help="per cent, in turn")
    parser.add_argument("--duplicate", type=float, default=0.0, help="per cent")
    parser.add_argument("--reorder", type=float, default=0.0, help="per cent")
    parser.add_argument("--delay", type=float, default=0.0, help="per cent of the packets, by 2 ms")
    parser.add_argument("--factor", type=float, default=0.3, help="dynamics_factor")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--fresh", action="store_true", help="begin anew")
    parser.add_argument("--judge", action="store_true", help="run nothing, print what is there")
    arguments = parser.parse_args()
    if arguments.fresh:
        shutil.rmtree(arguments.out, ignore_errors=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "turns.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    losses = [float(part) / 100.0 for part in arguments.loss.split(",")]
    others = {name: getattr(arguments, name) / 100.0 for name in ("duplicate", "reorder", "delay")}
    if (
        not arguments.judge
        and (
            left_s := 60.0 * arguments.minutes
            - sum(row["lasts_s"] for row in rows if row["moving"])
        )
        > 1.0
    ):
        folder = (arguments.out / f"cell-{len(rows)}").resolve()
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        options = ("--enforce-comm-constraints",)
        with served_fci(folder, options=options, factor=arguments.factor, with_box=True) as cell:
            cell.start_policy()
            end_s = time.monotonic() + left_s
            while (rest_s := end_s - time.monotonic()) > 1.0:
                faults = {"loss": losses[len(rows) % len(losses)], **others}
                rows.append(turn(cell, faults, min(TURN_S, rest_s)))
                with path.open("a") as lines:
                    lines.write(json.dumps(rows[-1]) + "\n")
    return 1 if report(rows) else 0


if __name__ == "__main__":
    sys.exit(main())
