"""Rows that reach the arm in time if the link to the model is slow, lossy or narrow.

    python benchmarks/bench_serve_links.py [--seconds 12] [--links 150/0/0/1000 400/0/0/1000 ...]

Two network namespaces, joined by a program that forwards Ethernet frames. A link is written
ROUND-TRIP/JITTER/LOSS/RATE [ms/ms/%/Mbit a second]: half the round trip each way, the jitter added
at random without reordering, the loss each way. A loss of 1~100 comes in bursts with a mean of 100
ms, as with radio: the link is dead for 1 % of the time.

One runs `roboneuron policy serve` with a model that takes 20 ms and answers chunks of 16 rows of 50
ms; the other runs the backend `shared` and the executor of the inference module, with one image of
224x224 for each prediction. A row that is not available when due counts as missed; the longest gap
is the longest hold. Needs root.

Bound: at a round trip of 150 ms at least 99 % of the rows are sent in time.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "plugins" / "rn-link" / "tests"))
sys.path.append(str(ROOT / "plugins" / "rn-backend-openpi" / "tests"))

from link_machines import Machine, impossible  # noqa: E402
from policy_servers import FarServer, pair  # noqa: E402
from slow_cable import Link, SlowCable, open_tap  # noqa: E402

from rn_backend_openpi.backend import PolicyBackend  # noqa: E402
from rn_backend_openpi.coding import CODINGS  # noqa: E402
from rn_backend_openpi.options import PolicyOptions  # noqa: E402
from rn_backend_openpi.plugin import SHARED  # noqa: E402
from rn_testing.fakes.backend import make_observation  # noqa: E402
from roboneuron import NotReadyError, RoboNeuronError  # noqa: E402
from roboneuron.modules.execution.adaptive import AdaptiveExecutor  # noqa: E402
from roboneuron.modules.execution.mode import Abilities  # noqa: E402
from roboneuron.modules.inference.execution import Bounds  # noqa: E402

LINKS = (
    "0/0/0/1000",
    "50/0/0/1000",
    "150/0/0/1000",
    "150/50/0/1000",
    "150/0/1/1000",
    "20/0/5/1000",
    "150/0/1~100/1000",
    "20/0/5~200/1000",
    "400/0/0/1000",
    "20/0/0/20",
    "20/0/0/5",
    "20/0/0/2",
)
ROWS, STEP_S, MODEL_S, SIDE = 16, 0.05, 0.02, 224
JUDGED_MS, LEAST_SHARE = 150.0, 0.99
MISSED = "missed: "
TIMEOUT_S = 1.0
WARM_S, FIRST_S = 4.0, 30.0
BOUNDS = Bounds(first_s=1.0)


def camera_image() -> NDArray[np.uint8]:
    """An image that compresses like a camera's: smooth, with a little noise."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    smooth = np.stack([columns * 255 / SIDE, rows * 255 / SIDE, (rows + columns) % 256], -1)
    noise = np.random.default_rng(0).integers(-4, 5, smooth.shape)
    return (smooth + noise).clip(0, 255).astype(np.uint8)


def robot(options: str, seconds: float) -> dict[str, Any]:
    """Execute rows for this time, and report how many were in time."""
    backend = PolicyBackend(PolicyOptions.model_validate_json(options))
    backend.load()
    executor = AdaptiveExecutor(Abilities(conditions_on_rows=True), fixed=None, bounds=BOUNDS)
    stop = threading.Event()
    told: dict[str, Any] = {"failed": 0, "predictions": 0, "metrics": {}}
    seen, image = make_observation(SHARED), camera_image()

    def predict() -> None:
        while not stop.is_set():
            if not executor.wait_until_wanted(stop, 0.1):
                continue
            now_ns = time.monotonic_ns()
            frame = replace(seen.frames["primary"], image=image, stamp_ns=now_ns)
            observation = replace(seen, frames={"primary": frame}, stamp_ns=now_ns)
            prediction = executor.begin(observation, now_ns)
            try:
                chunk = backend.predict(prediction.observation)
            except RoboNeuronError as error:
                told["failed"] += 1
                told["error"] = str(error)
                executor.drop()
                stop.wait(0.03)
                continue
            executor.answer(prediction, chunk, time.monotonic_ns())
            told["predictions"] += 1
            told["metrics"] = dict(chunk.metrics)

    thread = threading.Thread(target=predict, daemon=True)
    thread.start()
    sent_s: list[float] = []
    begun_s, starved = None, 0
    end_s = time.monotonic() + FIRST_S
    while time.monotonic() < end_s:
        try:
            row = executor.play(time.monotonic(), time.monotonic_ns())
        except NotReadyError as error:  # its image is too old, as after the parity check
            row = None
            told["error"] = str(error)
        now_s = time.monotonic()
        if row is not None:
            if begun_s is None:
                begun_s, end_s = now_s, now_s + WARM_S + seconds
            sent_s.append(now_s)
            if now_s < begun_s + WARM_S:
                starved = int(executor.values()["starved_periods"])
        time.sleep(0.001)
    stop.set()
    thread.join(30.0)
    if begun_s is None:
        told["none"] = f"No row came within {FIRST_S:g} s: {told.get('error')}"
        begun_s = end_s
    values = executor.values()
    counted = [at_s for at_s in sent_s if at_s >= begun_s + WARM_S]
    gaps_s = np.diff([begun_s + WARM_S, *counted, begun_s + WARM_S + seconds])
    backend.close()
    return {
        **told,
        "share": min(len(counted) * STEP_S / seconds, 1.0),
        "starved": int(values["starved_periods"]) - starved,
        "longest_gap_ms": float(gaps_s.max()) * 1e3,
        "mode": values["mode"],
        "latency_p50_ms": values.get("latency_p50_ms", 0.0),
    }


@contextmanager
def robot_before(link: Link) -> Iterator[Machine]:
    """The robot's machine; a policy server named gpu behind the link has one model."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        here, there = (
            stack.enter_context(closing(Machine(folder, name, number)))
            for number, name in enumerate(("robot", "gpu"), 1)
        )
        ends = [open_tap(side.pid, "cable") for side in (here, there)]
        for end in ends:
            stack.callback(os.close, end)
        for side in (here, there):
            side.run("ip", "addr", "add", f"{side.address}/24", "dev", "cable")
            for device in ("lo", "cable"):
                side.run("ip", "link", "set", device, "up")
        cable = SlowCable((ends[0], ends[1]), link)
        cable.start()
        stack.callback(cable.close)
        pair(here.state, there.state, address=there.address)
        own = {"rows": ROWS, "took_s": MODEL_S, "gain": 0.0002, "step_s": STEP_S}
        model = {"only": {"options": own}}
        server = FarServer(folder, model, {"host": "0.0.0.0", "port": 7420}, there.state)
        server.machine = there
        stack.callback(server.end)
        server.start()
        yield here


def ask_there(here: Machine, script: str, coding: str, *words: str) -> Any:
    """Run a script with `--robot OPTIONS *words` in that machine, and return its JSON output."""
    given = {"address": "gpu:7420", "timeout_s": TIMEOUT_S, "coding": coding}
    done = subprocess.run(
        here.inside(sys.executable, script, "--robot", json.dumps(given), *words),
        env={**os.environ, "XDG_STATE_HOME": str(here.state)},
        stdout=subprocess.PIPE,
        text=True,
        timeout=240.0,
        check=True,
    )
    return json.loads(done.stdout)


def measure(link: Link, coding: str, seconds: float) -> dict[str, Any]:
    """The robot's final report."""
    with robot_before(link) as here:
        found: dict[str, Any] = ask_there(here, __file__, coding, str(seconds))
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--links", nargs="+", default=LINKS)
    parser.add_argument("--coding", nargs="+", default=["auto"])
    parser.add_argument("--robot", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.robot:
        print(json.dumps(robot(given.robot[0], float(given.robot[1]))))
        return 0
    if reason := impossible():
        sys.exit(f"It {reason}.")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that servers and machines end too
    print(f"{os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}")
    print(
        "round trip/jitter/loss/Mbit  coding        rows in time  starved  longest gap  mode     "
        "answer p50  failed"
    )
    for text in given.links:
        link = Link.of(text)
        for coding in given.coding:
            found = measure(link, coding, given.seconds)
            used = CODINGS[int(found["metrics"].get("shared.coding", 0))]
            chosen = f"{coding} ({used})" if coding == "auto" else coding
            print(
                f"{text:<27}  {chosen:<12} {found['share']:13.1%} {found['starved']:8} "
                f"{found['longest_gap_ms']:9.0f} ms"
                f"  {found['mode']:<8} {found['latency_p50_ms']:7.0f} ms {found['failed']:7}",
                flush=True,
            )
            if "none" in found:
                print(found["none"])
            is_judged = (link.round_trip_ms, link.rate_mbit) == (JUDGED_MS, 1000.0)
            if is_judged and not link.loss_percent and found["share"] < LEAST_SHARE:
                print(f"{MISSED}{found['share']:.1%} of the rows came in time at {text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
