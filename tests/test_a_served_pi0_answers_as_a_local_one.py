"""A network on another machine: `roboneuron policy openpi` with a tiny pi0, called by the backend
`openpi`, answers like the same pi0 in this process.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.options import PolicyOptions
from rn_backend_pi0.native import Pi0Backend
from rn_backend_pi0.options import Pi0Options
from rn_backend_pi0.tiny import make_tiny
from roboneuron.contract import ActionChunk, Frame, JointSample, Observation

JOINTS = [f"fr3_joint{i}" for i in range(1, 8)]
CONFIG = """
[robot]
name = "fr3"
[inference]
backend = "pi0"
checkpoint = "{checkpoint}"
[plugins.pi0]
joints = {joints}
device = "cpu"
cpu_threads = 1
noise = "fixed"
[plugins.openpi]
{openpi}
[plugins.openpi.server]
port = 0
stateless = true
"""
DROID = {"profile": "droid", "joints": JOINTS}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny pi0 of DROID."""
    folder = tmp_path_factory.mktemp("pi0") / "tiny"
    make_tiny(folder, layout="openpi", profile="droid")
    (folder / "roboneuron.json").write_text('{"profile": "droid"}')
    return folder


@pytest.fixture(scope="module")
def seen() -> Observation:
    rng = np.random.default_rng(1)
    frames = {
        role: Frame(
            camera=role,
            image=rng.integers(0, 256, (120, 160, 3), dtype=np.uint8),
            stamp_ns=1,
            frame_id=role,
        )
        for role in ("primary", "wrist")
    }
    joints = JointSample(names=tuple(JOINTS), position=rng.uniform(-1.0, 1.0, 7))
    return Observation(frames=frames, instruction="go", joints=joints, gripper_open=0.25)


@pytest.fixture(scope="module")
def local(checkpoint: Path, seen: Observation) -> ActionChunk:
    """The network's answer in this process."""
    options = Pi0Options(
        checkpoint=checkpoint, joints=tuple(JOINTS), device="cpu", cpu_threads=1, noise="fixed"
    )
    backend = Pi0Backend(options)
    backend.load()
    chunk = backend.predict(seen)
    backend.close()
    return chunk


@contextmanager
def served(folder: Path, checkpoint: Path, openpi: str) -> Iterator[str]:
    """The command in a separate process; yields its URL."""
    path = folder / "gpu.toml"
    text = CONFIG.format(checkpoint=checkpoint, joints=json.dumps(JOINTS), openpi=openpi)
    path.write_text(text, encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "roboneuron.cli.main",
        "policy",
        "openpi",
        "--config",
        str(path),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.endswith("(backend pi0)\n")
            yield line.split()[2]
        finally:
            process.terminate()


def asked(url: str, options: dict[str, Any], observation: Observation) -> ActionChunk:
    given = {"url": url, "start_timeout_s": 30.0, "timeout_s": 30.0, **options}
    backend = PolicyBackend(PolicyOptions(**given))
    backend.load()
    try:
        return backend.predict(observation)
    finally:
        backend.close()


def test_the_networks_rows_are_the_same_to_the_bit(
    tmp_path: Path, checkpoint: Path, seen: Observation, local: ActionChunk
) -> None:
    with served(tmp_path, checkpoint, "") as url:
        chunk = asked(url, {"coding": "raw"}, seen)
    assert chunk.actions.tobytes() == local.actions.tobytes()
    assert (chunk.space, chunk.step_s) == (local.space, local.step_s)


@pytest.mark.exhaustive
def test_droids_own_keys_and_units_lead_to_the_same_rows(
    tmp_path: Path, checkpoint: Path, seen: Observation, local: ActionChunk
) -> None:
    raw = {**DROID, "image_size_px": "raw"}
    openpi = f'profile = "droid"\njoints = {json.dumps(JOINTS)}\nimage_size_px = "raw"'
    with served(tmp_path, checkpoint, openpi) as url:
        chunk = asked(url, raw, seen)
    # the state is transformed by 1 - (1 - opening), which is equal for a float32 network
    np.testing.assert_allclose(chunk.actions, local.actions, atol=1e-6)
    assert chunk.space == local.space
