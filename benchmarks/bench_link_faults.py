"""Faults of the link between a moving arm and the server of its policy, drawn at random and
evaluated one by one.

    python benchmarks/bench_link_faults.py [--trials 100] [--out out/bench/link-faults] [--judge]

Two machines (network namespaces): a simulated gantry with all its modules on one, `roboneuron
policy serve` on the other, with the keys of `roboneuron link`. Half of the trials have a local
fallback. Half reach the server through a program with the server's own keys that spoils answers
(`link_liar`). The number of a trial determines seed, cell and kind of fault. Each trial is a line
of JSON in OUT/trials.jsonl; an interrupted run can be resumed. Needs root.

Each trial is checked (`link_fault_judge`): joints within their limits; no step beyond STEP_M and no
speed beyond SPEED_M_S; no row from an image older than configured, and none from an older image
after a newer one; if answers stop for long, the fallback moves the arm without a pause and hands
back after three good seconds, or the arm holds; at the end the remote policy moves the arm. Exit
status 1 if a trial fails.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "plugins" / "rn-link" / "tests"))
sys.path.append(str(ROOT / "plugins" / "rn-backend-openpi" / "tests"))

from fault_loop import environment, moving_cell  # noqa: E402
from link_fault_judge import AGAIN_S, Judge, Witness  # noqa: E402
from link_faults import DIRECT, RATE_HZ, ROWS, SPOILT, STEP_S, Site, Trial  # noqa: E402
from link_machines import impossible, machines  # noqa: E402
from policy_servers import pair  # noqa: E402

from rn_testing.spinning import spinning_node  # noqa: E402
from roboneuron import RoboNeuronError  # noqa: E402
from roboneuron.selection.requests import StartChosenInference  # noqa: E402
from roboneuron.server.loop import ClosedLoop  # noqa: E402
from roboneuron.tools.loop.instructing import give_instruction  # noqa: E402

OUT = Path("out/bench/link-faults")
LEDGER = "trials.jsonl"
SHARED = """
[plugins.shared]
address = "gpu:7420"
timeout_s = 0.3
coding = "raw"
"""
"""Pixels encode the number of an image, which JPEG would change."""
POLICY = f"rows = {ROWS}\nstep_s = {STEP_S}\n"


def instruct(loop: ClosedLoop) -> str:
    """Request motion again after a stop that requires a new start; returns its reason."""
    view = loop.modules.view("inference")
    if view.phase != "running":
        with contextlib.suppress(RoboNeuronError):
            loop.start("inference", StartChosenInference(instruction="move on", options={}))
        return "the inference module had ended"
    report = view.report
    if report is None or not report.needs_start:
        return ""
    with contextlib.suppress(RoboNeuronError):  # repeated as long as nothing moves
        give_instruction(loop, "move on", 10.0)
    return report.needs_start


def work(folder: Path, numbers: Sequence[int], ledger: Path) -> None:
    """Run the trials of one cell, inside the robot's machine."""
    first = Trial.of(numbers[0])
    facts = json.loads((folder / "facts.json").read_text())
    more = {
        "backend": "shared",
        "inference": 'fallback = "steadier"' if first.has_fallback else "",
        "camera": SHARED,
        "policy": POLICY,
    }
    cell = folder / "cell"
    cell.mkdir(exist_ok=True)
    with environment(cell):  # the server finds the policy too
        site = Site(folder, facts, is_spoilt=first.is_spoilt)
        site.spoil("")
        site.start()
        try:
            with (
                moving_cell(cell, RATE_HZ, **more) as (loop, _),
                spinning_node("gantry") as node,
            ):
                seen = Witness(node)
                for number in numbers:
                    told = Judge(seen, partial(instruct, loop), Trial.of(number)).run(site)
                    with ledger.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(told) + "\n")
                    print(json.dumps(told), flush=True)
        finally:
            site.close()


def hardware_of(words: Sequence[str]) -> str:
    """Address of the Ethernet device of a machine."""
    shown = subprocess.run(
        [*words, "ip", "-json", "link", "show", "cable"],
        check=True,
        capture_output=True,
        timeout=60,
    )
    return str(json.loads(shown.stdout)[0]["address"])


def run_cell(numbers: Sequence[int], ledger: Path) -> None:
    """Create two machines, and let one of them run the trials."""
    folder = Path(tempfile.mkdtemp(prefix="rn-faults-"))
    try:
        with machines(folder, "robot", "gpu") as both:
            here, there = both["robot"], both["gpu"]
            pair(here.state, there.state, address=there.address)
            names = ("stranger-robot", "stranger-gpu")
            pair(folder / names[0], folder / names[1], address=there.address)
            facts = {
                "gpu_pid": there.pid,
                "gpu_state": str(there.state),
                "robot_state": str(here.state),
                "gpu_address": there.address,
                "robot_address": here.address,
                "gpu_hardware": hardware_of(there.inside()),
                "robot_hardware": hardware_of(here.inside()),
            }
            (folder / "facts.json").write_text(json.dumps(facts))
            words = [sys.executable, __file__, "--work", str(folder), str(ledger.resolve())]
            words += [str(number) for number in numbers]
            variables = {"XDG_STATE_HOME": str(here.state), "ROBONEURON_LINK": "off"}
            worker = subprocess.Popen(here.inside(*words), env={**os.environ, **variables})
            try:
                code = worker.wait(180.0 + 2.5 * AGAIN_S * len(numbers))
            finally:
                worker.send_signal(signal.SIGTERM)
                worker.wait(60.0)
        if code:
            print(f"The worker of {numbers} ended with {code}.", flush=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def read(ledger: Path) -> list[dict[str, Any]]:
    """All trials so far."""
    lines = ledger.read_text(encoding="utf-8").splitlines() if ledger.exists() else []
    return [json.loads(line) for line in lines]


def table(trials: Sequence[dict[str, Any]]) -> int:
    """Print the results; returns the number of failed trials."""
    print("|fault|trials|fallback took over|longest rest with it s|back s|oldest image s|wrong|")
    print("|---" * 7 + "|")
    for kind in (*DIRECT, *SPOILT):
        own = [trial for trial in trials if trial["kind"] == kind]
        if not own:
            continue
        second = [trial for trial in own if trial["has_fallback"]]
        took = sum(trial.get("took_over", False) for trial in second)
        stood = max((trial.get("stood_s", 0.0) for trial in second), default=0.0)
        back = max(trial.get("back_s", 0.0) for trial in own)
        oldest = max(trial.get("oldest_s", 0.0) for trial in own)
        wrong = Counter(word for trial in own for word in trial["wrong"])
        said = "; ".join(f"{count} x {word}" for word, count in wrong.items()) or "-"
        print(
            f"|{kind}|{len(own)}|{took}/{len(second)}|{stood:.1f}|{back:.1f}|{oldest:.2f}|{said}|"
        )
    failed = sum(bool(trial["wrong"]) for trial in trials)
    speed = max((trial.get("speed_m_s", 0.0) for trial in trials), default=0.0)
    step = max((trial.get("step_mm", 0.0) for trial in trials), default=0.0)
    stopped = sum(bool(trial.get("stopped")) for trial in trials)
    print(f"{stopped} were stopped by the machine itself and instructed anew")
    print(f"{len(trials)} trials, {failed} failed; fastest {speed} m/s, largest step {step} mm")
    return failed


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the missing trials, and print all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=100, help="numbers 0 to this one")
    parser.add_argument("--share", type=int, default=9, help="trials of one cell")
    parser.add_argument("--only", nargs="+", type=int, help="these numbers alone")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--judge", action="store_true", help="only print what is there")
    parser.add_argument("--work", nargs="+", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that servers end too
    if given.work:
        folder, ledger, *numbers = given.work
        work(Path(folder), [int(number) for number in numbers], Path(ledger))
        return 0
    given.out.mkdir(parents=True, exist_ok=True)
    ledger = given.out / LEDGER
    if not given.judge:
        if reason := impossible():
            sys.exit(f"It {reason}.")
        done = {trial["number"] for trial in read(ledger)}
        missing = [n for n in given.only or range(given.trials) if n not in done]
        for cell in range(4):
            own = [number for number in missing if number % 4 == cell]
            for begin in range(0, len(own), given.share):
                run_cell(own[begin : begin + given.share], ledger)
    return 1 if table(read(ledger)) else 0


if __name__ == "__main__":
    sys.exit(main())
