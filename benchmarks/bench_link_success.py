"""Success of the learned policy on cubes as a function of the link to its server, with the
evaluation's clock.

    python benchmarks/bench_link_success.py [--episodes 20] [--links 150/0/0/1000/auto ...]

First, the answers of a policy server behind each link are timed in real time, from the image to the
answer: `bench_serve_links` creates the link, ROUND-TRIP/JITTER/LOSS/RATE/CODING, and a model that
takes 20 ms. An answer that missed its deadline of 1 s counts as one of 1 s: all its rows are too
old. Then `roboneuron eval run` runs the same seeds with times drawn from these, sequential and
overlapped: simulated time stops while the policy computes, so the load of this machine has no
effect. The draws ignore that slow answers come in bursts, and the effect of JPEG on images.

Everything is stored in `--out`; an interrupted run can be resumed. The first part needs root.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_serve_links import TIMEOUT_S, ask_there, camera_image, robot_before
from link_machines import impossible
from slow_cable import Link

from rn_backend_shared.backend import SharedBackend
from rn_backend_shared.images import CODINGS
from rn_backend_shared.options import SharedOptions
from rn_backend_shared.plugin import BACKEND
from rn_eval.ledger import read_records
from rn_eval.record import EpisodeRecord
from rn_eval.statistics import success_of
from rn_testing.fakes.backend import make_observation
from roboneuron import RoboNeuronError

LINKS = (
    "0/0/0/1000/auto",
    "50/0/0/1000/auto",
    "150/0/0/1000/auto",
    "400/0/0/1000/auto",
    "150/50/0/1000/auto",
    "150/0/1/1000/auto",
    "20/0/5/1000/auto",
    "20/0/0/20/auto",
    "20/0/0/5/auto",
    "20/0/0/2/auto",
    "20/0/0/20/raw",
    "20/0/0/5/raw",
    "20/0/0/2/raw",
    "150/0/0/1000/png",
    "20/0/0/20/png",
    "20/0/0/5/png",
    "20/0/0/2/png",
)
EXECUTIONS = ("sequential", "overlap")
FIRST_SEED = 20_000
STEP_S = 0.1
ANSWERS, ANSWERS_S, WARM = 80, 60.0, 5
PAUSE_S = 0.2
"""Pause between an answer and the next request, as caused by executing a chunk."""
ROUNDS = (2, 5, 10, 20, 35, 50, 100, 200)
"""Episodes are added to all links equally, so that an interrupted run still compares them."""
OUT = Path("out/bench/link-success")
PROGRAM = str(Path(sys.executable).with_name("roboneuron"))


def robot(options: str) -> dict[str, Any]:
    """Send requests repeatedly, and return the time of each answer."""
    backend = SharedBackend(SharedOptions.model_validate_json(options))
    backend.load()
    seen, image = make_observation(BACKEND), camera_image()
    took_s: list[float] = []
    failed, coding = 0, 0
    end_s = time.monotonic() + ANSWERS_S
    while len(took_s) < ANSWERS + WARM and time.monotonic() < end_s:
        begun_ns = time.monotonic_ns()
        frame = replace(seen.frames["primary"], image=image, stamp_ns=begun_ns)
        try:
            chunk = backend.predict(replace(seen, frames={"primary": frame}, stamp_ns=begun_ns))
        except RoboNeuronError:
            failed += 1
            took_s.append(TIMEOUT_S)
        else:
            coding = int(chunk.metrics["shared.coding"])
            took_s.append((time.monotonic_ns() - begun_ns) / 1e9)
        time.sleep(PAUSE_S)
    backend.close()
    return {"took_s": took_s[WARM:], "failed": failed, "coding": CODINGS[coding]}


def times_of(text: str, folder: Path) -> tuple[Path, dict[str, Any]]:
    """File of the answer times of a link [s], and further facts about them; measured if missing."""
    path = folder / f"{text.replace('/', '-')}.txt"
    known = path.with_suffix(".json")
    if not known.exists():
        link, _, coding = text.rpartition("/")
        with robot_before(Link.of(link)) as here:
            found = ask_there(here, __file__, coding)
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"{value:.4f}\n" for value in found["took_s"]))
        known.write_text(json.dumps(found))
        print(f"{text}: {len(found['took_s'])} answers, {found['failed']} failed", flush=True)
    facts: dict[str, Any] = json.loads(known.read_text())
    return path, facts


LONGEST_S = 12 * 3600
"""Time limit of one run of the evaluation, which can be resumed."""


def play(
    files: Sequence[Path], executions: Sequence[str], episodes: int, workers: int, out: Path
) -> None:
    """Run the missing episodes with each file of times and each execution mode."""
    policy = out / "policy"
    if not policy.exists():
        subprocess.run([PROGRAM, "cubes-policy", "unpack", str(policy)], check=True, timeout=300)
    words = ["--checkpoint", str(policy), "--config", str(policy / "roboneuron.toml")]
    for path in files:
        words += ["--latency", f"file:{path}"]
    more = ["--execution", ",".join(executions), "--seed", str(FIRST_SEED), "--strips", "none"]
    more += ["--workers", str(workers)]
    for count in sorted({episodes, *(size for size in ROUNDS if size < episodes)}):
        size = ["--episodes", str(count), "--out", str(out / "episodes"), "--retry-errors"]
        subprocess.run(
            [PROGRAM, "eval", "run", "--backend", "oft-primary", *words, *more, *size],
            check=True,
            stdout=subprocess.DEVNULL,
            timeout=LONGEST_S,
        )


def cell_of(records: Sequence[EpisodeRecord]) -> str:
    """Results of a variant's episodes: success, its interval, rows in time, time held."""
    if not records:
        return "-"
    moved_s = sum(record.outcome.rows for record in records) * STEP_S
    played_s = sum(record.outcome.duration_s for record in records)
    found = success_of(records)
    return (
        f"{found.successes}/{found.trials} [{found.low:.0%},{found.high:.0%}] "
        f"{min(moved_s / played_s, 1.0):.0%} {max(played_s - moved_s, 0.0) / len(records):.1f}"
    )


def table(found: dict[str, tuple[Path, dict[str, Any]]], out: Path) -> None:
    """Print the existing results."""
    by_variant: dict[tuple[str, str], list[EpisodeRecord]] = defaultdict(list)
    for record in read_records(out / "episodes"):
        by_variant[record.key.latency, record.key.execution].append(record)
    each = "successes/seeds [95 %] rows in time, held s an episode"
    print(f"|link|coding|answer ms p50/p95|missed|{'|'.join(f'{e}: {each}' for e in EXECUTIONS)}|")
    print("|---" * (4 + len(EXECUTIONS)) + "|")
    for text, (path, facts) in found.items():
        took_ms = np.array(facts["took_s"]) * 1e3
        link, _, coding = text.rpartition("/")
        used = f"auto: {facts['coding']}" if coding == "auto" else coding
        cells = [cell_of(by_variant[f"file:{path}", execution]) for execution in EXECUTIONS]
        middle, late = np.percentile(took_ms, (50, 95))
        first = f"|{link}|{used}|{middle:.0f}/{late:.0f}|{facts['failed']}|"
        print(first + "|".join(cells) + "|")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, play, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=20, help="seeds of each variant")
    parser.add_argument("--links", nargs="+", default=LINKS)
    parser.add_argument("--executions", nargs="+", choices=EXECUTIONS, default=EXECUTIONS)
    parser.add_argument("--workers", type=int, default=1, help="episodes at a time")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--answers", action="store_true", help="only time answers")
    parser.add_argument("--judge", action="store_true", help="only print what is there")
    parser.add_argument("--robot", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.robot:
        print(json.dumps(robot(given.robot)))
        return 0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that servers and machines end too
    folder = given.out / "answers"
    known = [text for text in given.links if (folder / f"{text.replace('/', '-')}.json").exists()]
    if given.judge:
        given.links = known
    elif len(known) < len(given.links) and (reason := impossible()):
        sys.exit(f"It {reason}.")
    found = {text: times_of(text, folder) for text in given.links}
    if given.answers:
        return 0
    if not given.judge:
        files = [path for path, _ in found.values()]
        play(files, given.executions, given.episodes, given.workers, given.out)
    table(found, given.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
