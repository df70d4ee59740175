"""Real SGLang compared with the in-process runtime: the same tokens, and the cost of the boundary.

    check.py --python SGLANG_ENVIRONMENT/bin/python [--device cpu] [--requests 20]

Creates tiny checkpoints itself. Exits with 1 if a token differs.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import secrets
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from rn_runtime_sglang.config import SglangRuntimeConfig
from rn_runtime_sglang.process import ManagedServer
from rn_runtime_sglang.runtime import SglangRuntime
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from rn_vla.decoding import PolicyModel, TokenRequest
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.policy import policy_model, prompt_encoder, token_request
from rn_vla.openvla.preprocessing import Preprocessor
from rn_vla.openvla.prompt import end_prompt
from rn_vla.openvla.tiny import make_tiny, write_tokenizer
from roboneuron.errors import CheckpointError, NotReadyError

SEED = 3
"""A checkpoint whose tokens depend on image and prompt; with some seeds one token always
dominates.
"""
PROMPTS = ("pick up the red bowl", "close the drawer", "put the cube on the plate")
SIZES = ((224, 224), (240, 320), (480, 640))
KEY_VARIABLE = "INTEROP_KEY"
GOLDEN = Path(__file__).parents[2] / "rn-backend-openvla" / "tests" / "data" / "openvla-tiny"
_VERSIONS = "import importlib.metadata as m, json; print(json.dumps({n: m.version(n) for n in %r}))"

Connect = Callable[[PolicyModel, str], SglangRuntime]


@dataclass(frozen=True, kw_only=True, slots=True)
class Fixture:
    """A checkpoint with everything needed for its requests."""

    model: PolicyModel
    checkpoint: OpenvlaCheckpoint
    preprocessor: Preprocessor

    @classmethod
    def read(cls, path: Path) -> Fixture:
        """Read a checkpoint directory."""
        checkpoint = OpenvlaCheckpoint.read(path)
        return cls(
            model=policy_model(checkpoint, action_width=7, max_prompt_tokens=128),
            checkpoint=checkpoint,
            preprocessor=Preprocessor(
                size=checkpoint.vision.towers[0].image, towers=checkpoint.towers
            ),
        )

    def request(self, ids: np.ndarray, image: np.ndarray) -> TokenRequest:
        """Create one request."""
        pixels = self.preprocessor.to_pixels(image)
        return token_request(text="", ids=ids, image=image, pixel_values=pixels, action_width=7)


def picture(generator: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """A smooth random image, whose compressibility resembles a camera's."""
    small = Image.fromarray(generator.integers(0, 256, (9, 12, 3), dtype=np.uint8))
    whole = np.asarray(small.resize((size[1], size[0]), Image.Resampling.BICUBIC)).astype(np.int16)
    return np.clip(whole + generator.integers(-3, 4, whole.shape), 0, 255).astype(np.uint8)


def print_versions(python: Path) -> None:
    """Print the versions of the packages."""
    names = ("sglang", "torch", "transformers", "rn-runtime-sglang", "rn-vla")
    done = subprocess.run([python, "-c", _VERSIONS % (names,)], capture_output=True, check=True)
    ours = {
        name: importlib.metadata.version(name)
        for name in ("torch", "rn-runtime-torch", "roboneuron-core")
    }
    print(f"server:  {json.loads(done.stdout)}")
    print(f"client:  {ours}, Python {platform.python_version()}, {os.cpu_count()} CPUs")


def compare(name: str, pairs: list[tuple[list[int], list[int]]]) -> bool:
    """Print and compare pairs of (expected, served) tokens."""
    same = sum(a == b for a, b in pairs)
    distinct = len({tuple(a) for a, _ in pairs})
    print(
        f"{name}: {same} of {len(pairs)} replies have all 7 tokens equal; {distinct} different "
        "replies"
    )
    for expected, served in pairs:
        print(f"  {expected}" if expected == served else f"  {expected} EXPECTED, SERVED {served}")
    return same == len(pairs)


def check_golden(served: SglangRuntime, fixture: Fixture) -> bool:
    """Compare with the results of the public modelling code."""
    golden = np.load(GOLDEN / "golden.npz")
    request = fixture.request(end_prompt(golden["input_ids"][0]), golden["image_0"])
    return compare(
        "original code, golden checkpoint",
        [(golden["tokens"].tolist(), served.run(request).tokens.tolist())],
    )


def check_faults(
    connect: Connect, served: SglangRuntime, request: TokenRequest, other: Fixture
) -> bool:
    """Test a late answer and the wrong model on the real server."""
    try:
        served.run(replace(request, deadline_s=time.monotonic() + 0.03))
        late = "answered within 30 ms"
    except NotReadyError as error:
        late = str(error)
    print(f"deadline of 30 ms: {late}")
    metrics = served.run(request).metrics
    ready = metrics["served.servers_ready"]
    print(f"  next request answered; late {metrics['served.late']:.0f}, servers ready {ready:.0f}")
    try:
        connect(other.model, "bmp").close()
    except CheckpointError as error:
        print(f"another checkpoint behind the URL: {error}")
        return True
    print("another checkpoint behind the URL was NOT noticed")
    return False


def measure(rows: dict[str, list[dict[str, float]]]) -> None:
    """Print medians."""
    print(
        f"{'':26}{'whole ms':>10}{'encode ms':>11}{'engine ms':>11}"
        f"{'transport ms':>14}{'request kB':>12}"
    )
    for name, samples in rows.items():
        whole, encode, trip, engine, size = (
            statistics.median(sample.get(key, float("nan")) for sample in samples)
            for key in (
                "model_ms",
                "served.encode_ms",
                "served.round_trip_ms",
                "served.model_ms",
                "served.request_bytes",
            )
        )
        print(
            f"{name:26}{whole:10.1f}{encode:11.2f}{engine:11.1f}"
            f"{trip - engine:14.1f}{size / 1e3:12.1f}"
        )


def main() -> int:
    """Run everything; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", type=Path, required=True)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--requests", type=int, default=20)
    options = parser.parse_args()
    import torch

    torch.set_num_threads(max(1, (os.cpu_count() or 2) // 2))
    print_versions(options.python)
    with tempfile.TemporaryDirectory(prefix="rn-interop-") as held:
        good = run(options, Path(held))
    print("PASSED" if good else "FAILED")
    return 0 if good else 1


def run(options: argparse.Namespace, directory: Path) -> bool:
    """Run all checks with checkpoints in `directory`."""
    make_tiny(directory / "tiny", seed=SEED)
    shutil.copytree(GOLDEN, directory / "golden")
    write_tokenizer(directory / "golden" / "tokenizer.json")
    tiny, golden = Fixture.read(directory / "tiny"), Fixture.read(directory / "golden")
    limits = {"timeout_s": 20.0, "start_timeout_s": 900.0}
    managed = SglangRuntimeConfig(
        python=options.python.absolute(), device=options.device, dtype="float32", **limits
    )
    os.environ[KEY_VARIABLE] = secrets.token_hex(16)
    server = ManagedServer(managed, tiny.checkpoint.path, os.environ[KEY_VARIABLE])
    started_s = time.monotonic()
    url = server.start()
    watching = threading.Thread(
        target=end_with, args=(server,), name="watching the server", daemon=True
    )
    watching.start()

    def connect(model: PolicyModel, image_format: str) -> SglangRuntime:
        made = SglangRuntime(
            SglangRuntimeConfig(
                urls=(url,), key_variable=KEY_VARIABLE, image_format=image_format, **limits
            )
        )
        made.load(model)
        return made

    good = True
    try:
        served = connect(tiny.model, "bmp")
        print(f"server ready and warm after {time.monotonic() - started_s:.0f} s")
        good &= check_tiny(options, tiny, golden, served, connect)
        served.close()
    finally:
        started_s = time.monotonic()
        server.stop()
        print(f"server ended after {time.monotonic() - started_s:.1f} s")
    launched = SglangRuntime(managed)
    try:
        launched.load(golden.model)
        good &= check_golden(launched, golden)
    finally:
        launched.close()
    return good


def end_with(server: ManagedServer) -> None:
    """End this process when the server ends by itself, which would otherwise be noticed only at the
    start's time-out.
    """
    while not (failure := server.failure()):
        time.sleep(0.5)
    print(f"FAILED: {failure}", flush=True)
    os._exit(1)


def check_tiny(
    options: argparse.Namespace,
    tiny: Fixture,
    golden: Fixture,
    served: SglangRuntime,
    connect: Connect,
) -> bool:
    """Check tokens, faults and latency with the tiny checkpoint."""
    encoder = prompt_encoder(tiny.checkpoint, "v02")
    generator = np.random.default_rng(0)
    requests = [
        tiny.request(encoder.to_ids(encoder.to_text(prompt)), picture(generator, size))
        for prompt in PROMPTS
        for size in SIZES
    ]
    local = TorchRuntime(TorchRuntimeConfig(device=options.device, dtype="float32"))
    local.load(tiny.model)
    pairs = [(local.run(r).tokens.tolist(), served.run(r).tokens.tolist()) for r in requests]
    good = (
        compare("in-process runtime, tiny checkpoint", pairs)
        and len({tuple(a) for a, _ in pairs}) > 3
    )
    good &= check_faults(connect, served, requests[0], golden)
    compressed = connect(tiny.model, "png")
    rows: dict[str, list[dict[str, float]]] = {}
    for _ in range(options.requests):
        for size in ((224, 224), (480, 640)):
            request = tiny.request(requests[0].prompt.ids, picture(generator, size))
            for name, runtime in (
                ("in process", local),
                ("served, bmp", served),
                ("served, png", compressed),
            ):
                row = rows.setdefault(f"{name}, {size[1]}x{size[0]}", [])
                row.append(dict(runtime.run(request).metrics))
    compressed.close()
    print(
        f"latency, medians of {options.requests} requests each, alternating, all images different:"
    )
    measure(rows)
    return good


if __name__ == "__main__":
    sys.exit(main())
