"""Hundreds of damaged checkpoints, created, loaded and run under limits of memory and time, in a
separate process.

    corruptions.py LAYOUT[,LAYOUT] DIRECTORY [STRIDE]

Writes a tiny checkpoint of each LAYOUT into DIRECTORY, damages a copy for every case (or every
STRIDE-th), and prints one JSON object per case.
"""

from __future__ import annotations

import itertools
import json
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from damaged_files import Case, files, numbers, safetensors, texts, tokenizers
from damaged_layouts import HEADS, JSON_FILES, WEIGHT_FILES, lerobot, oft, openpi, openvla_only
from damaged_pickles import pickles

SECONDS = 20
"""CPU time limit of a case, with ten times that as wall-clock limit; good ones take below 1 s."""
GROWTH_BYTES = 2 * 2**30
"""Address space that a case may add to the process."""


def make(layout: str, directory: Path) -> None:
    """Write a tiny checkpoint."""
    if layout.startswith("pi0"):
        from rn_backend_pi0.tiny import make_tiny as make_pi0

        make_pi0(directory, layout="openpi" if layout == "pi0-openpi" else "lerobot")
    elif layout == "oft":
        from rn_backend_oft.tiny import make_tiny_oft

        make_tiny_oft(directory)
    else:
        from rn_vla.openvla.tiny import make_tiny

        make_tiny(directory)


def act(layout: str, directory: Path) -> list[float]:
    """Action of a checkpoint for one fixed observation."""
    import numpy as np

    from roboneuron.contract import Frame, Observation, Pose

    picture = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    frames = {
        role: Frame(camera=role, image=picture, stamp_ns=1, frame_id=role)
        for role in ("primary", "wrist")
    }
    observation = Observation(
        frames=frames,
        instruction="pick up the red cube and put it on the blue plate",
        ee_pose=Pose(
            position_m=np.array([0.4, 0.0, 0.5]), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0])
        ),
        gripper_open=0.5,
    )
    backend = _backend(layout, directory)
    try:
        backend.load()
        return [float(value) for value in backend.predict(observation).actions.ravel()]
    finally:
        backend.close()


def _backend(layout: str, directory: Path) -> Any:
    if layout.startswith("pi0"):
        from rn_backend_pi0.native import Pi0Backend
        from rn_backend_pi0.options import Pi0Options

        return Pi0Backend(Pi0Options(checkpoint=directory, device="cpu", profile="libero"))
    from rn_runtime_torch.config import TorchRuntimeConfig
    from rn_runtime_torch.runtime import TorchRuntime

    runtime = TorchRuntime(TorchRuntimeConfig(device="cpu"))
    if layout == "oft":
        from rn_backend_oft.backend import OftBackend
        from rn_backend_oft.config import OftConfig

        config = OftConfig(checkpoint=directory, profile="libero", constants="libero", proprio=True)
        return OftBackend(config, runtime=runtime)
    from rn_backend_openvla.backend import OpenVlaBackend
    from rn_backend_openvla.config import OpenVlaConfig

    return OpenVlaBackend(OpenVlaConfig(checkpoint=directory, profile="libero"), runtime=runtime)


def cases(layout: str, original: Path) -> Iterator[Case]:
    """Every damage to one layout."""
    for name in JSON_FILES[layout]:
        yield from files(name)
        yield from texts(name)
    for name in JSON_FILES[layout]:
        if name != "tokenizer.json" and not name.endswith("index.json"):
            yield from numbers(name, json.loads((original / name).read_text()))
    yield from tokenizers()
    for name in WEIGHT_FILES[layout]:
        yield from files(name)
        yield from safetensors(name)
    for name in HEADS.get(layout, []):
        yield from files(name)
        yield from pickles(name)
    yield from _SPECIAL[layout]()


_SPECIAL = {"openvla": openvla_only, "oft": oft, "pi0-lerobot": lerobot, "pi0-openpi": openpi}


def _memory(word: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(word):
            return int(line.split()[1]) * 1024
    raise LookupError(word)


def _expire(*_: object) -> None:
    raise TimeoutError(f"took more than {SECONDS} s")


def _run(layout: str, directory: Path, expected: list[float]) -> dict[str, object]:
    from roboneuron.errors import RoboNeuronError

    Path("/proc/self/clear_refs").write_text("5")  # restarts the peak of resident memory
    before, started = _memory("VmRSS"), time.monotonic()
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.alarm(10 * SECONDS)
    try:
        same = act(layout, directory) == expected
        outcome, text = ("same action" if same else "other action"), ""
    except RoboNeuronError as error:
        outcome, text = type(error).__name__, str(error)
    except BaseException as error:
        outcome, text = f"raw {type(error).__name__}", str(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
    grown = _memory("VmHWM") - before
    return {
        "outcome": outcome,
        "text": text[:3000],
        "length": len(text),
        "seconds": time.monotonic() - started,
        "grown_bytes": grown,
    }


def main(layouts: str, scratch: Path, stride: int) -> None:
    """See the module."""
    import torch

    torch.set_num_threads(1)
    os.chdir(scratch)
    for layout in layouts.split(","):
        _damage(layout, scratch, stride)


def _damage(layout: str, scratch: Path, stride: int) -> None:
    """Print the results of the damages to one layout."""
    most = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    original = scratch / layout
    make(layout, original)
    expected = act(layout, original)
    for number in (signal.SIGPROF, signal.SIGALRM):
        signal.signal(number, _expire)
    limit = _memory("VmSize") + GROWTH_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, most))
    for name, damage in itertools.islice(cases(layout, original), 0, None, stride):
        directory = scratch / "damaged"
        shutil.copytree(original, directory)
        damage(directory)
        result = _run(layout, directory, expected) | {
            "layout": layout,
            "case": name,
            "executed": (scratch / "executed").exists(),
        }
        print(json.dumps(result), flush=True)
        shutil.rmtree(directory)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]).resolve(), int(sys.argv[3]) if len(sys.argv) > 3 else 1)
