"""`roboneuron policy check`: the configured backend on data sets of either layout and on runs."""

from __future__ import annotations

import builtins
import json
import sys
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from policy_datasets import write_dataset
from policy_runs import write_run

from rn_recorder_policy.command import CheckPolicy
from rn_recorder_runs.lerobot import export
from rn_recorder_runs.store import Run
from rn_testing.fakes.site import PluginSite, plugin_site
from roboneuron import ConfigurationError, InvalidInputError, MissingDependencyError

CONFIG = """
[robot]
name = "toy"
[inference]
backend = "knowing"
[control]
controller = "toy"
[plugins.knowing]
kind = "{kind}"
"""
Call = Callable[..., tuple[int, str]]


@pytest.fixture
def call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Call:
    """Run the command with the policy of a kind of space; its status and what it printed."""
    monkeypatch.setenv("COLUMNS", "160")
    with plugin_site(tmp_path / "site") as site:
        assert isinstance(site, PluginSite)
        site.install("rn-toy", "", value="policy_plugin")

        def run(kind: str, *words: str) -> tuple[int, str]:
            config = tmp_path / "roboneuron.toml"
            config.write_text(CONFIG.format(kind=kind))
            parser = ArgumentParser()
            command = CheckPolicy()
            command.configure(parser)
            arguments = parser.parse_args(["--config", str(config), *words])
            return command.run(arguments), capsys.readouterr().out

        yield run


def test_a_data_set_agrees_with_its_policy(call: Call, tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "set", "joint_position")
    status, text = call("joint_position", "--dataset", str(path), "--episode", "1")
    assert status == 0
    assert "The answers agree with the recorded actions." in text
    assert "knowing on toy: 50 frames of episode 1 of" in text
    (line,) = [line for line in text.splitlines() if line.startswith("joint4")]
    assert line.split()[2] == "rad"


def test_a_fault_is_named_and_told_to_programs(call: Call, tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "set", "joint_velocity", version="v2.1")
    words = ("--dataset", str(path), "--option", "fault=velocity-sign-6")
    status, text = call("joint_velocity", *words)
    assert status == 1
    assert "sign: joint6: the answers have the opposite sign." in text
    status, text = call("joint_velocity", *words, "--json")
    told = json.loads(text)
    assert status == 1
    assert told["space"].startswith("joint_velocity@10:joint1,")
    assert [(f["kind"], f["channels"]) for f in told["faults"]] == [("sign", ["joint6"])]
    (wrong,) = [one for one in told["channels"] if one["channel"] == "joint6"]
    assert wrong["scale"] == pytest.approx(-1.0, abs=0.05)
    assert wrong["correlation"] < -0.9
    assert told["frames"] == 50
    assert not told["agrees"]


def test_a_lag_is_measured(call: Call, tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "set", "joint_velocity")
    _, text = call(
        "joint_velocity",
        *("--dataset", str(path), "--episode", "1", "--json"),
        *("--option", "fault=velocity-shift-4"),
    )
    lags = [one["lag_rows"] for one in json.loads(text)["channels"][:7]]
    assert lags == [-4] * 7


def test_a_recording_of_our_own_is_checked(call: Call, tmp_path: Path) -> None:
    for kind in ("ee_delta", "joint_position"):
        folder = write_run(tmp_path / kind, kind)
        status, text = call(kind, "--dataset", str(folder))
        assert status == 0, text
        assert f"of episode 0 of the run {kind!r}" in text
    status, text = call(
        "ee_delta",
        *("--dataset", str(tmp_path / "ee_delta" / "part-0001.mcap")),
        *("--option", "fault=delta-swap-x-y"),
    )
    assert status == 1
    assert "swapped: dx_m has the values of dy_m" in text


def test_what_we_export_is_checked(call: Call, tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", "joint_velocity")
    run = Run(id="run", kind="recording", files=(folder / "part-0001.mcap",), facts={})
    export([run], tmp_path / "set", outcome=None, fps=None, codec="av1")
    status, text = call("joint_velocity", "--dataset", str(tmp_path / "set"))
    assert status == 0, text


def test_names_are_mapped_and_never_guessed(call: Call, tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "set", "joint_position", renamed=True)
    words = ("--dataset", str(path), "--episode", "1")
    with pytest.raises(InvalidInputError, match="names no joint1, joint2") as refusal:
        call("joint_position", *words)
    assert "It names: motor_0, motor_1" in str(refusal.value)
    assert "--map" in refusal.value.hint
    mapped = [f"--map=action:motor_{i}=joint{i + 1}" for i in range(7)]
    mapped += [f"--map=observation.state:motor_{i}=joint{i + 1}" for i in range(7)]
    mapped += ["--map=action:motor_7=gripper_open", "--map=observation.state:motor_7=finger"]
    assert call("joint_position", *words, *mapped)[0] == 0
    swapped = [
        word.replace("motor_0=", "motor_x=") for word in mapped if word.startswith("--map=a")
    ]
    with pytest.raises(ConfigurationError, match="'action:motor_x', which the data set does not"):
        call("joint_position", *words, *swapped)
    with pytest.raises(ConfigurationError, match="NAME=CHANNEL"):
        call("joint_position", *words, "--map", "motor_0")
    assert call("joint_position", *words, "--in-order")[0] == 0
    with pytest.raises(InvalidInputError, match="'action' has 8 values, the backend yields 7"):
        call("ee_delta", *words, "--in-order")


def test_degrees_are_told_and_converted_only_when_asked(call: Call, tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "set", "joint_position", unit="deg")
    words = ("--dataset", str(path), "--episode", "1")
    assert call("joint_position", *words, "--unit", "deg")[0] == 0


def test_cameras_are_found_by_name_or_role(call: Call, tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "set", "ee_delta")
    info = path / "meta/info.json"
    info.write_text(info.read_text().replace("observation.images.front", "observation.images.top"))
    entries = path / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(entries)
    names = [name.replace("images.front", "images.top") for name in table.column_names]
    pq.write_table(table.rename_columns(names), entries)
    (path / "videos/observation.images.front").rename(path / "videos/observation.images.top")
    words = ("--dataset", str(path), "--episode", "1")
    with pytest.raises(InvalidInputError, match="no pictures front or primary") as refusal:
        call("ee_delta", *words)
    assert "It has: top" in str(refusal.value)
    assert call("ee_delta", *words, "--camera", "primary=top")[0] == 0
    with pytest.raises(ConfigurationError, match="the role 'wrist'; the backend has primary"):
        call("ee_delta", *words, "--camera", "wrist=top")


def test_what_cannot_be_checked_is_refused_in_a_sentence(call: Call, tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "set", "ee_delta")
    words = ("--dataset", str(path), "--episode", "1")
    with pytest.raises(InvalidInputError, match=r"neither a LeRobot data set .* nor a recording"):
        call("ee_delta", "--dataset", str(tmp_path))
    with pytest.raises(InvalidInputError, match="has no episode 9"):
        call("ee_delta", "--dataset", str(path), "--episode", "9")
    with pytest.raises(InvalidInputError, match=r"episode 0 of .* has 7 rows, 10 are needed"):
        call("ee_delta", "--dataset", str(path), "--episode", "0")
    with pytest.raises(InvalidInputError, match="--frames is 3"):
        call("ee_delta", *words, "--frames", "3")
    with pytest.raises(InvalidInputError, match=r"has no feature 'action.left'"):
        call("ee_delta", *words, "--action", "action.left")
    (path / "videos/observation.images.front/chunk-000/file-000.mp4").unlink()
    with pytest.raises(InvalidInputError, match=r"The video .* is missing"):
        call("ee_delta", *words)
    info = path / "meta/info.json"
    info.write_text(info.read_text().replace("v3.0", "v1.6"))
    with pytest.raises(InvalidInputError, match=r"has the version 'v1.6'"):
        call("ee_delta", *words)


@pytest.mark.parametrize(("package", "told"), [("pyarrow", "pyarrow"), ("av", "PyAV")])
def test_a_missing_extra_says_what_to_install(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, told: str
) -> None:
    path = write_dataset(tmp_path / "set", "ee_delta")
    ordinary = builtins.__import__

    def without(name: str, *rest: object, **named: object) -> object:
        if name.partition(".")[0] == package:
            raise ImportError(name)
        return ordinary(name, *rest, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError, match=told) as refusal:
        call("ee_delta", "--dataset", str(path), "--episode", "1")
    assert "rn-recorder[export]" in refusal.value.hint


def test_a_backend_of_another_interpreter_is_run_there(call: Call, tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "set", "ee_delta")
    config = tmp_path / "other.toml"
    text = CONFIG.format(kind="ee_delta")
    config.write_text(
        text.replace('backend = "knowing"', 'backend = "knowing"\npython = "/opt/its/bin/python"')
    )
    with pytest.raises(ConfigurationError, match="/opt/its/bin/python") as refusal:
        call("ee_delta", "--config", str(config), "--dataset", str(path), "--episode", "1")
    assert "/opt/its/bin/roboneuron policy check" in refusal.value.hint
    assert sys.executable in str(refusal.value)
