"""The command, the monitor and their package keep their contracts."""

from __future__ import annotations

from argparse import ArgumentParser
from functools import cache
from pathlib import Path

import pytest

from rn_policy_cubes import checkpoint as checkpoint_module
from rn_policy_cubes.command import CubesPolicy
from rn_policy_cubes.monitor.contract_case import case
from rn_standard.tasks.contract_cases import MonitorCase
from rn_standard.tasks.hooks import MonitorSpec
from rn_testing.contracts import contract_of
from roboneuron import ConfigurationError


@cache
def rendered_case() -> MonitorCase:
    """The monitor's case, which takes seconds to render."""
    return case()


class TestMonitor(contract_of(MonitorSpec)):
    @pytest.fixture
    def plugin(self) -> MonitorCase:
        return rendered_case()


def run(*words: str) -> int:
    parser = ArgumentParser()
    command = CubesPolicy()
    command.configure(parser)
    return command.run(parser.parse_args(words))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("steps", "NAME=VALUE"),
        ("steps=0", "greater than or equal to 1"),
        ("colour=red", "colour: Extra inputs"),
    ],
)
def test_a_wrong_recipe_is_refused(setting: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=message):
        run("train", "--out", str(tmp_path), "--set", setting)


@pytest.mark.exhaustive
def test_from_nothing_to_a_checkpoint(
    shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ["shards=2", "steps=2", "views=2", "full_views=2", "tokens=20"]
    settings = [word for setting in small for word in ("--set", setting)]
    assert run("train", "--out", str(tmp_path / "run"), "--data", str(shards), *settings) == 0
    assert run("pack", "--out", str(tmp_path / "run"), "--to", str(tmp_path / "packed")) == 0
    assert run("unpack", str(tmp_path / "checkpoint"), "--weights", str(tmp_path / "packed")) == 0
    assert "step 2 of 2" in capsys.readouterr().out
    assert (tmp_path / "checkpoint" / "model.safetensors").exists()


def test_a_build_without_weights_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("rn_policy_cubes.weights.WEIGHTS_FILE", "absent.safetensors")
    with pytest.raises(ConfigurationError, match="has no weights"):
        checkpoint_module.shipped_configuration(tmp_path)
