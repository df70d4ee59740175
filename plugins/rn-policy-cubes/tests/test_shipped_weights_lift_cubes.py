"""The weights in the package solve the task in the closed loop, through rn-backend-oft."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rn_policy_cubes.checkpoint import shipped_configuration
from rn_policy_cubes.weights import shipped_weights
from roboneuron.cli.main import main

pytest.importorskip("rn_eval")

MOST_BYTES = 8_000_000


def test_weights_are_small() -> None:
    assert shipped_weights().stat().st_size <= MOST_BYTES


@pytest.mark.parametrize("seeds", [2, pytest.param(5, marks=pytest.mark.exhaustive)])
def test_the_policy_lifts_the_named_cube(tmp_path: Path, seeds: int) -> None:
    """Nine of ten scenes succeed; another processor rounds differently, so one of these may
    fail.
    """
    config = shipped_configuration(tmp_path)
    policy = [
        "--backend",
        "oft-primary",
        "--checkpoint",
        str(config.parent),
        "--config",
        str(config),
    ]
    out = tmp_path / "run"
    scenes = ["--episodes", str(seeds), "--seed", "10000", "--strips", "none", "--out", str(out)]
    assert main(["eval", "run", "-q", *policy, *scenes]) == 0
    lines = [
        json.loads(line)["outcome"] for line in (out / "episodes.jsonl").read_text().splitlines()
    ]
    assert len(lines) == seeds
    lifted = [line for line in lines if line["status"] == "success"]
    assert len(lifted) >= seeds - 1
    assert all(line["facts"]["right_object"] == 1.0 for line in lifted)
    assert all(line["facts"]["lifted_cm"] > 10 for line in lifted)
