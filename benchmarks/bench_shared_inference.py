"""Eight robots on one shared model: answers in batches compared with one at a time, in the same
run.

    python benchmarks/bench_shared_inference.py [--model tiny|learned] [--clients 8] [--seconds 1.5]
    [--rounds 9]

The model `tiny` is synthetic (128 layers of 256, random weights, one CPU thread): as with a large
model on a GPU, a forward pass costs little more for eight observations than for one. `--layers 12
--width 2048` is a model whose products are limited by the CPU's arithmetic instead. Two servers of
rn-backend-openpi hold it, one with `most = 1`, one with `most = 8`; rounds alternate between them.
Each client sends the next request after each answer: first without an effective deadline, which
gives the throughput, then with one of 12 forward passes, at least 100 ms, which counts the misses.

`--model learned` is the policy of rn-policy-cubes (OpenVLA-OFT layout, 256 visual tokens) in
float32 on one thread; its prompts have several lengths. One thread computes eight no faster than
one, so throughput and misses are shown without a bound.

Bounds: chunks of batches within 1e-5 of those of single answers; with `tiny`, answers per second at
least 3 times those of one at a time (median of the rounds' ratios), and the fraction of missed
deadlines not larger.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import threading
import time
import tomllib
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.plugin import SHARED
from rn_testing.fakes.backend import make_observation
from rn_testing.fakes.site import PluginSite
from roboneuron import NotReadyError, Observation

LEAST_RATIO, MOST_DIFFERENCE, DEADLINE_FORWARDS = 3.0, 1e-5, 12.0
LEAST_DEADLINE_S, FREE_S = 0.1, 60.0
"""Throughput is measured without effective deadlines."""
JOIN_S = 120.0
"""Longest wait for a client; a prediction is bounded by its deadline."""
SOURCE = '''
import numpy as np
import torch

from pydantic import BaseModel
from roboneuron import ActionChunk, BackendSpec, hookimpl

SIDE = 16


class Options(BaseModel):
    layers: int
    width: int


class Tiny:
    """Pictures of 16 x 16 through residual layers; any number of them in one forward."""

    def __init__(self, config, *, runtime=None, acceleration=None):
        self._layer_count, self._width = config.layers, config.width

    def load(self):
        torch.set_num_threads(1)
        width = self._width
        drawn = torch.Generator().manual_seed(0)
        self._first = torch.randn(3 * SIDE * SIDE, width, generator=drawn) * (3 * SIDE * SIDE) ** -0.5
        self._layers = [torch.randn(width, width, generator=drawn) * width**-0.5 for _ in range(self._layer_count)]
        self._last = torch.randn(width, 7 * 8, generator=drawn) * width**-0.5

    def predict(self, observation):
        return self.predict_batch([observation])[0]

    @torch.inference_mode()
    def predict_batch(self, observations):
        images = np.stack([o.frames["primary"].image[:SIDE, :SIDE] for o in observations])
        hidden = torch.from_numpy(images.reshape(len(images), -1).astype(np.float32) / 255.0) @ self._first
        for layer in self._layers:
            hidden = hidden + torch.relu(hidden @ layer)
            hidden = hidden / hidden.norm(dim=-1, keepdim=True) * self._width**0.5
        rows = 0.01 * torch.tanh(hidden @ self._last).double().numpy().reshape(len(images), 8, 7)
        rows[:, :, 6] = 0.5
        return [ActionChunk(actions=actions, step_s=0.1) for actions in rows]

    def reset(self):
        pass

    def close(self):
        pass


@hookimpl
def roboneuron_backends():
    return [
        BackendSpec(
            name="tiny-benchmark", summary="Tiny.", target=__name__ + ":Tiny", config=__name__ + ":Options"
        )
    ]
'''  # noqa: E501


@dataclass
class Count:
    """Answers to clients in a round."""

    answered: int = 0
    missed: int = 0
    batches: float = 0.0


ASKED = (
    "pick up the red cube",
    "grab the yellow cube",
    "lift the blue cube off the table",
    "take the green one",
)


def seen(number: int) -> Observation:
    """Observation of a robot, with its own noise."""
    observation = make_observation(SHARED, ASKED[number % len(ASKED)])
    image = np.random.default_rng(number).integers(0, 256, (224, 224, 3), dtype=np.uint8)
    return replace(
        observation, frames={"primary": replace(observation.frames["primary"], image=image)}
    )


def play(robots: list[PolicyBackend], seconds: float) -> Count:
    """Let all robots send requests continuously."""
    counts = [Count() for _ in robots]
    end_s = time.monotonic() + seconds

    def ask(robot: PolicyBackend, count: Count, observation: Observation) -> None:
        while time.monotonic() < end_s:
            try:
                chunk = robot.predict(observation)
            except NotReadyError:
                count.missed += 1
            else:
                count.answered += 1
                count.batches += chunk.metrics["shared.batch"]

    threads = [
        threading.Thread(target=ask, args=(robot, count, seen(index)))
        for index, (robot, count) in enumerate(zip(robots, counts, strict=True))
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(JOIN_S)
    return Count(
        *(
            sum(getattr(count, name) for count in counts)
            for name in ("answered", "missed", "batches")
        )
    )


def forward_s(robot: PolicyBackend) -> float:
    """Time of one observation alone, in the server [s]."""
    return (
        statistics.median(robot.predict(seen(0)).metrics["shared.model_ms"] for _ in range(20))
        / 1e3
    )


def model_options(given: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """The model of the servers, as fields of `PolicyOptions`."""
    if given.model == "tiny":
        PluginSite(path=folder / "site").install("rn-tiny-benchmark", SOURCE, header="")
        return {
            "backend": "tiny-benchmark",
            "options": {"layers": given.layers, "width": given.width},
        }
    from rn_policy_cubes.checkpoint import CONFIGURATION_FILE, unpack
    from rn_policy_cubes.packing import Packed
    from rn_policy_cubes.weights import shipped_weights

    checkpoint = folder / "learned"
    unpack(Packed.read(shipped_weights()), checkpoint)
    options = tomllib.loads((checkpoint / CONFIGURATION_FILE).read_text())["plugins"]["oft-primary"]
    return {
        "backend": "oft-primary",
        "options": options,
        "runtime_options": {"device": "cpu", "dtype": "float32", "threads": 1},
        "acceleration": given.preset,
    }


def main() -> int:
    """Run it; exit status 0 if all bounds hold."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", choices=("tiny", "learned"), default="tiny")
    parser.add_argument("--preset", help="acceleration of the learned policy, such as fastv-p50")
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=1.5, help="of each round")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--layers", type=int, default=128)
    parser.add_argument("--width", type=int, default=256)
    given = parser.parse_args()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        model = model_options(given, folder)
        path = os.pathsep.join(filter(None, (str(folder / "site"), os.environ.get("PYTHONPATH"))))

        def connect(most: int, timeout_s: float) -> PolicyBackend:
            made = PolicyBackend(
                PolicyOptions(
                    **model,
                    most=most,
                    timeout_s=timeout_s,
                    idle_s=5.0,
                    directory=folder / "run",
                    environment={"PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
                )
            )
            stack.callback(made.close)
            made.load()
            return made

        alone = connect(1, FREE_S)
        once_s = forward_s(alone)
        deadline_s = max(DEADLINE_FORWARDS * once_s, LEAST_DEADLINE_S)
        sizes = (1, given.clients)
        free = [[connect(most, FREE_S) for _ in range(given.clients)] for most in sizes]
        due = [[connect(most, deadline_s) for _ in range(given.clients)] for most in sizes]
        expected = [alone.predict(seen(index)).actions for index in range(given.clients)]
        difference, largest = compare(free[1], expected)
        print(f"{os.cpu_count()} CPUs, load {load:.1f} before, torch on one thread")
        print(f"one forward {once_s * 1e3:.1f} ms, {given.clients} clients")
        print(
            f"round  one at a time  in batches  ratio  batch   missed of {deadline_s * 1e3:.0f} ms"
        )
        ratios, missed, asked = [], [0, 0], [0, 0]
        for number in range(given.rounds):
            one, many = (play(robots, given.seconds) for robots in free)
            ratios.append(many.answered / max(one.answered, 1))
            for index, robots in enumerate(due):
                count = play(robots, given.seconds)
                missed[index] += count.missed
                asked[index] += count.missed + count.answered
            print(
                f"{number + 1:>5} {one.answered / given.seconds:>12.1f}/s "
                f"{many.answered / given.seconds:>9.1f}/s "
                f"{ratios[-1]:>6.2f} {many.batches / max(many.answered, 1):>6.1f}   "
                + " / ".join(
                    f"{part} of {whole}" for part, whole in zip(missed, asked, strict=True)
                )
            )
        ratio = statistics.median(ratios)
        wanted = f"at least {LEAST_RATIO:g}" if given.model == "tiny" else "not judged"
        print(f"median ratio {ratio:.2f} ({wanted}); load {os.getloadavg()[0]:.1f} after")
        print(
            f"deadline misses {missed[1]} of {asked[1]} (one at a time {missed[0]} of {asked[0]})"
        )
        print(
            f"batches of up to {largest:g}: {difference:.1e} from those answered alone (at most "
            f"{MOST_DIFFERENCE:g})"
        )
        is_fast = ratio >= LEAST_RATIO and missed[1] * asked[0] <= missed[0] * asked[1]
        is_same = difference <= MOST_DIFFERENCE and largest > 1
        return 0 if is_same and (is_fast or given.model == "learned") else 1


def compare(robots: list[PolicyBackend], expected: list[np.ndarray]) -> tuple[float, float]:
    """Largest difference of an action from `expected`, and the largest batch, with simultaneous
    requests.
    """
    worst, largest = 0.0, 0.0

    def ask(index: int) -> None:
        nonlocal worst, largest
        for _ in range(20):
            try:
                chunk = robots[index].predict(seen(index))
            except NotReadyError:
                continue
            worst = max(worst, float(np.abs(chunk.actions - expected[index]).max()))
            largest = max(largest, chunk.metrics["shared.batch"])

    threads = [threading.Thread(target=ask, args=(index,)) for index in range(len(robots))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(JOIN_S)
    return worst, largest


if __name__ == "__main__":
    sys.exit(main())
