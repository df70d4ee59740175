"""The flow weights in the package solve the task in the closed loop, through rn-backend-pi0."""

from __future__ import annotations

import json
from argparse import ArgumentParser
from pathlib import Path

import pytest

from rn_policy_cubes.command import CubesPolicy
from rn_policy_cubes.weights import shipped_flow_weights
from roboneuron import ConfigurationError
from roboneuron.cli.main import main

pytest.importorskip("rn_eval")
pytest.importorskip("rn_backend_pi0")

MOST_BYTES = 4_000_000


def unpack(directory: Path) -> int:
    parser = ArgumentParser()
    command = CubesPolicy()
    command.configure(parser)
    return command.run(parser.parse_args(["flow", "unpack", str(directory)]))


def test_weights_are_small() -> None:
    assert shipped_flow_weights().stat().st_size <= MOST_BYTES


@pytest.mark.parametrize("seeds", [1, pytest.param(4, marks=pytest.mark.exhaustive)])
def test_the_flow_policy_lifts_the_named_cube(tmp_path: Path, seeds: int) -> None:
    """Nearly all scenes succeed; another processor rounds differently, so one of these may fail."""
    policy = tmp_path / "policy"
    assert unpack(policy) == 0
    chosen = ["--backend", "pi0", "--checkpoint", str(policy)]
    chosen += ["--config", str(policy / "roboneuron.toml"), "--execution", "rtc"]
    out = tmp_path / "run"
    scenes = ["--episodes", str(seeds), "--seed", "20000", "--latency", "112ms"]
    scenes += ["--strips", "none", "--out", str(out)]
    assert main(["eval", "run", "-q", *chosen, *scenes]) == 0
    lines = [
        json.loads(line)["outcome"] for line in (out / "episodes.jsonl").read_text().splitlines()
    ]
    assert len(lines) == seeds
    assert all("rtc" in line["modes"] for line in lines)
    lifted = [line for line in lines if line["status"] == "success"]
    assert len(lifted) >= max(1, seeds - 1)
    assert all(line["facts"]["right_object"] == 1.0 for line in lifted)


def test_a_build_without_flow_weights_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("rn_policy_cubes.weights.FLOW_FILE", "absent.safetensors")
    with pytest.raises(ConfigurationError, match="no weights of the flow policy"):
        unpack(tmp_path / "policy")
