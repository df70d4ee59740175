"""Record how a scripted person corrects a learned policy where it fails, as one LeRobot data set.

    python benchmarks/record_corrections.py --episodes 40 [--minutes 30] [--seed 500]
    roboneuron policy cubes improve --corrections out/corrections/data-set \\
        --suite-option 'displaced_m=[0.06,-0.03,0]'

The cell is a server with the simulated FR3 and the learned policy; the camera beside the table is
not where it was in training (--displaced). A scene is played once for each cube. If the policy is
too slow, stands still, closes on nothing or lifts another cube, the person takes over through the
page's websocket, acts as the teacher would until the cube is lifted, and hands back. Each episode
is a recording, labelled, and a line of the ledger in --out; the ledger is continued. --episodes
counts the corrected ones. Those in which the arm could not be corrected stay in the ledger, and out
of the data set.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from correcting_person import CorrectingPerson, Truth, policy_holds
from page_cell import PageCell, served

from rn_policy_cubes.checkpoint import BACKEND, configuration, unpack
from rn_policy_cubes.demonstrations import COLOURS
from rn_policy_cubes.packing import Packed
from rn_policy_cubes.weights import shipped_weights
from rn_simulation.ground_truth import LIFTED_M
from roboneuron import RoboNeuronError
from roboneuron.ros.environment import prepare_environment

CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
cameras = ["front"]
[inference]
backend = "{backend}"
[control]
controller = "urdf"
[view]
enabled = true
port = 0
image_hz = 1.0
[supervisor]
state_directory = "{state}"
[recorder]
directory = "{runs}"
ring_s = 0.0
exclude = ["*/transition_event", "*/sim/state", "/tf"]
[plugins.fr3]
seed = {seed}
[plugins.fr3-sim-camera]
displaced_m = {displaced}
"""
OUT = Path("out/corrections")
LEDGER, RUNS, DATA_SET = "ledger.jsonl", "runs", "data-set"
DISPLACED = (0.06, -0.03, 0.0)
PATIENCE_S = 12.0
"""Time after which a policy that has not lifted the cube fails; it usually needs 4 s."""
STILL_S, STILL_M = 3.0, 0.004
"""Time without a displacement of the TCP of this size after which the policy stands still."""
NOTHING_OPEN, NOTHING_S = 0.3, 0.5
"""Opening that is less than any cube, and how long it counts as a miss."""
HELD_S = 1.0
CORRECT_S = 60.0
EXPORT_S = 1800.0
ATTEMPTS = 3
"""Attempts to give an instruction, to play an episode that is broken off, and to start a cell."""
CORRECTED, ALONE, FAILED, BROKEN = "corrected", "by the policy", "not corrected", "broken"


def why_it_fails(truth: Truth, colour: str) -> str:
    """Watch the policy until it has lifted the cube (returns "") or fails (returns why)."""
    moved_s = time.monotonic()
    end_s = moved_s + PATIENCE_S
    held_s = shut_s = 0.0
    place = truth.row(colour)["tcp_m"]
    while (now_s := time.monotonic()) < end_s:
        row, lifted = truth.row(colour), truth.lifted_m()
        held_s = (held_s or now_s) if lifted[colour] > LIFTED_M else 0.0
        if held_s:
            # a lift that has begun in time may end
            end_s = max(end_s, held_s + 2.0 * HELD_S)
        if held_s and now_s - held_s > HELD_S:
            return ""
        other = max((one for one in COLOURS if one != colour), key=lifted.__getitem__)
        if lifted[other] > LIFTED_M / 2:
            return f"it lifts the {other} cube"
        shut_s = (shut_s or now_s) if row["opening"] < NOTHING_OPEN else 0.0
        if shut_s and now_s - shut_s > NOTHING_S:
            return "it closes on nothing"
        if float(((row["tcp_m"] - place) ** 2).sum()) ** 0.5 > STILL_M:
            place, moved_s = row["tcp_m"], now_s
        if now_s - moved_s > STILL_S and not held_s:
            return "it stands still"
        time.sleep(0.05)
    return f"not lifted within {PATIENCE_S:g} s"


def instruct(cell: PageCell, instruction: str) -> None:
    """Give an instruction; on a busy machine the first images may be too old to be acted on."""
    for attempt in range(1, ATTEMPTS + 1):
        try:
            cell.do("set_instruction", instruction=instruction)
            return
        except RuntimeError:
            if attempt == ATTEMPTS:
                raise


def play(cell: PageCell, truth: Truth, person: CorrectingPerson, colour: str) -> dict[str, Any]:
    """One episode, recorded and labelled; returns its row of the ledger."""
    person.leads, person.led_s = 0, 0.0
    cell.do("take_over")
    run = str(cell.do("start_recording", name="correction")["id"])
    begun_s = time.monotonic()
    try:
        instruct(cell, f"pick up the {colour} cube")
        why = why_it_fails(truth, colour)
        row: dict[str, Any] = {"run": run, "why": why, "policy_s": time.monotonic() - begun_s}
        outcome = ALONE
        if why:
            problem = person.correct(colour, CORRECT_S)
            back = person.hand_back()
            is_kept = not problem and policy_holds(truth, colour, 6.0, 0.5)
            outcome = FAILED if problem else CORRECTED
            row |= {"problem": problem or back, "kept": is_kept}
            row |= {"person_s": person.led_s, "leads": person.leads}
    finally:
        cell.do("take_over")
        cell.do("stop_recording")
    is_good = outcome in (ALONE, CORRECTED)
    label = "success" if is_good else "failure"
    cell.do("label_recording", run=run, outcome=label, comment=f"{outcome}: {why}"[:500])
    return {"outcome": outcome, **row}


def play_scene(arguments: argparse.Namespace, seed: int, folder: Path, ledger: Ledger) -> None:
    """Run the episodes of a scene that are not in the ledger yet."""
    text = configuration(folder.parent / "checkpoint")
    policy = text[text.index(f"[plugins.{BACKEND}]") :]
    config = policy + CONFIG.format(
        backend=BACKEND,
        state=folder / "state",
        runs=(arguments.out / RUNS).resolve(),
        seed=seed,
        displaced=json.dumps(arguments.displaced),
    )
    with served(folder, partial(PageCell, folder, config)) as cell, ExitStack() as stack:
        cell.do("start_inference")
        truth = Truth("fr3", stack)
        person = CorrectingPerson(cell.url, truth)
        stack.callback(person.close)
        for colour in COLOURS:
            if ledger.has(seed, colour) or ledger.count >= arguments.episodes:
                continue
            if time.monotonic() > arguments.end_s:
                return
            begun_s = time.monotonic()
            try:
                row = play(cell, truth, person, colour)
            except (RuntimeError, TimeoutError, AssertionError, OSError) as error:
                row = {"outcome": BROKEN, "problem": str(error)[:300]}
            took = {"took_s": time.monotonic() - begun_s, "load": os.getloadavg()[0]}
            ledger.add({"seed": seed, "colour": colour, **row, **took})
            if problem := person.put_down(colour):
                print(f"     the cube was not put down: {problem}", flush=True)
                return


class Ledger:
    """The episodes so far, a line of JSON each."""

    def __init__(self, path: Path) -> None:
        self._path = path
        text = path.read_text() if path.exists() else ""
        # a process that was killed may leave an incomplete line
        whole = text[: text.rfind("\n") + 1]
        if whole != text:
            path.write_text(whole)
        self.rows: list[dict[str, Any]] = [json.loads(line) for line in whole.splitlines()]

    @property
    def count(self) -> int:
        """Number of corrected episodes."""
        return len(self.corrected)

    @property
    def corrected(self) -> list[dict[str, Any]]:
        """Rows of the corrected episodes."""
        return [row for row in self.rows if row["outcome"] == CORRECTED]

    def has(self, seed: int, colour: str) -> bool:
        """Whether this episode was played to its end, or was broken off too often."""
        found = [row for row in self.rows if (row["seed"], row["colour"]) == (seed, colour)]
        broken = sum(row["outcome"] == BROKEN for row in found)
        return len(found) > broken or broken >= ATTEMPTS

    def add(self, row: dict[str, Any]) -> None:
        """Append a row and print it."""
        self.rows.append(row)
        with self._path.open("a") as lines:
            lines.write(json.dumps(row) + "\n")
        told = row.get("why") or row.get("problem", "")
        print(
            f"{self.count:3}: scene {row['seed']}, {row['colour']}: {row['outcome']}; {told}; "
            f"policy {row.get('policy_s', 0.0):.1f} s, person {row.get('person_s', 0.0):.1f} s",
            flush=True,
        )


def report(rows: list[dict[str, Any]]) -> None:
    """Print counts and medians."""
    print(f"{len(rows)} episodes: {dict(Counter(row['outcome'] for row in rows))}")
    print(f"reasons: {dict(Counter(row['why'] for row in rows if row.get('why')))}")
    led = [row for row in rows if row["outcome"] == CORRECTED]
    if not led:
        return
    for name, of in (("policy_s", "the policy alone"), ("person_s", "the person")):
        times = [row[name] for row in led]
        print(
            f"corrected: {of} {statistics.median(times):.1f} s (median), {max(times):.1f} at most"
        )
    kept = sum(row["kept"] for row in led)
    print(f"the policy held the cube after the hand-back in {kept} of {len(led)}")
    print(f"leads: {sum(row['leads'] for row in led)}; load {max(r['load'] for r in rows):.0f}")


def export(out: Path, rows: list[dict[str, Any]]) -> None:
    """Write the data set of the corrected episodes, unless there is one."""
    if (out / DATA_SET).exists():
        print(f"{out / DATA_SET} exists; delete it to export again")
        return
    words = ["runs", "--directory", str(out / RUNS), "export", *[row["run"] for row in rows]]
    words += ["--lerobot", str(out / DATA_SET), "--outcome", "success", "--codec", "h264"]
    # status 1 means that incomplete episodes were left out, which it says
    subprocess.run(
        [sys.executable, "-P", "-m", "roboneuron.cli.main", *words], check=False, timeout=EXPORT_S
    )


def main() -> int:
    """Play scenes until enough episodes are corrected, or the time is over; then export."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--episodes", type=int, default=40, help="corrected ones (default: 40)")
    parser.add_argument("--minutes", type=float, default=1e6, help="of this call; then go on later")
    parser.add_argument("--seed", type=int, default=500, help="the first scene (default: 500)")
    parser.add_argument("--displaced", type=float, nargs=3, default=DISPLACED, metavar="M")
    parser.add_argument("--weights", type=Path, help="packed file; default: the shipped one")
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    (arguments.out / RUNS).mkdir(parents=True, exist_ok=True)
    ledger, seed, failures = Ledger(arguments.out / LEDGER), arguments.seed, 0
    arguments.end_s = time.monotonic() + 60.0 * arguments.minutes
    os.environ["ROBONEURON_RECORDER"] = "on"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare_environment(folder / "log")
        unpack(Packed.read(arguments.weights or shipped_weights()), folder / "checkpoint")
        for number in count():
            if ledger.count >= arguments.episodes or time.monotonic() > arguments.end_s:
                break
            while all(ledger.has(seed, colour) for colour in COLOURS):
                seed += 1
            try:
                play_scene(arguments, seed, folder / str(number), ledger)
                failures = 0
            except (RuntimeError, AssertionError, RoboNeuronError) as error:
                failures += 1
                print(f"     the cell of scene {seed} failed: {str(error)[:300]}", flush=True)
                if failures == ATTEMPTS:
                    raise
    report(ledger.rows)
    if ledger.count >= arguments.episodes:
        export(arguments.out, ledger.corrected)
    return 0 if (arguments.out / DATA_SET).exists() else 1


if __name__ == "__main__":
    raise SystemExit(main())
