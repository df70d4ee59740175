"""The command `roboneuron-pi0`."""

from __future__ import annotations

from pathlib import Path

import pytest

from rn_backend_pi0.cli import main


@pytest.mark.parametrize("layout", ["lerobot", "openpi"])
def test_a_tiny_checkpoint_is_made_and_found_complete(
    tmp_path: Path, layout: str, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "new" / "tiny"
    assert main(["make-tiny", str(target), "--layout", layout]) == 0
    assert main(["check", str(target)]) == 0
    shown = capsys.readouterr().out
    assert f"family          {layout}" in shown
    assert "all accounted for" in shown
    assert sum(path.stat().st_size for path in target.rglob("*")) < 500_000


@pytest.mark.parametrize(("variant", "backend"), [("pi05", "pi0"), ("pi0_fast", "pi0-fast")])
def test_the_backend_that_runs_a_variant_is_named(
    tmp_path: Path, variant: str, backend: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["make-tiny", str(tmp_path / "tiny"), "--variant", variant]) == 0
    assert f"checkpoint of backend '{backend}'" in capsys.readouterr().out


def test_the_same_seed_makes_the_same_weights(tmp_path: Path) -> None:
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        assert main(["make-tiny", str(tmp_path / name), "--seed", seed]) == 0
    weights = [(tmp_path / name / "model.safetensors").read_bytes() for name in "abc"]
    assert weights[0] == weights[1] != weights[2]


def test_a_directory_that_holds_something_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.txt").write_text("keep me")
    assert main(["make-tiny", str(tmp_path)]) == 1
    assert "not an empty directory" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_damaged_checkpoint_is_reported_without_a_traceback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(tmp_path)]) == 1
    assert "config.json" in capsys.readouterr().err
