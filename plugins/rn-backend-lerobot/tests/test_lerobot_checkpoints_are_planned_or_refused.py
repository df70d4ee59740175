"""Properties of a checkpoint known before loading, and refusals by name."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_folders import ARM, write_tensors

from rn_backend_lerobot.isolation import check_release
from rn_backend_lerobot.options import LeRobotOptions
from rn_backend_lerobot.space import lerobot_space
from rn_backend_lerobot.tensor_file import read_tensors
from rn_backend_lerobot.wiring import wire
from roboneuron import (
    CheckpointError,
    ConfigurationError,
    MissingDependencyError,
    RobotProfile,
)

Make = Callable[..., Path]
Options = dict[str, Any]
NORMALIZER = "policy_preprocessor_step_3_normalizer_processor.safetensors"
UNNORMALIZER = "policy_postprocessor_step_0_unnormalizer_processor.safetensors"


def test_a_checkpoint_says_its_space(
    checkpoint: Make, options: Options, robot: RobotProfile
) -> None:
    space = lerobot_space({**options, "checkpoint": checkpoint()}, robot)
    assert space.label == f"joint_position@20:{','.join(ARM)},gripper_open"
    assert [channel.unit for channel in space.channels] == ["rad"] * 7 + ["opening"]


def test_the_space_is_known_without_lerobot_and_pytorch(checkpoint: Make, options: Options) -> None:
    code = (
        "import sys; from rn_backend_lerobot.options import LeRobotOptions; "
        "from rn_backend_lerobot.wiring import wire; import rn_backend_lerobot.space; "
        "print(wire(LeRobotOptions.model_validate_json(sys.stdin.read())).space.label); "
        "print([m for m in ('torch', 'lerobot', 'transformers') if m in sys.modules])"
    )
    given = json.dumps({**options, "checkpoint": str(checkpoint("smolvla"))})
    done = subprocess.run(
        [sys.executable, "-c", code], input=given, capture_output=True, text=True, check=True
    )
    label, heavy = done.stdout.split("\n")[:2]
    assert label.startswith("joint_position@20:")
    assert heavy == "[]"


@pytest.mark.parametrize("kind", ["joint_delta", "joint_velocity"])
def test_other_spaces_of_joints_are_named_by_the_option(
    checkpoint: Make, options: Options, robot: RobotProfile, kind: str
) -> None:
    space = lerobot_space({**options, "checkpoint": checkpoint(), "space": kind}, robot)
    assert space.kind == kind
    assert space.channels[0].unit == ("rad/s" if kind == "joint_velocity" else "rad")


@pytest.mark.parametrize(
    ("kind", "names", "units"),
    [
        ("ee_delta", ["dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad"], "mmmrrr"),
        ("ee_pose", ["x", "y", "z", "qx", "qy", "qz", "qw"], "mmm1111"),
    ],
)
def test_spaces_of_the_tcp_are_named_by_the_option(
    checkpoint: Make, robot: RobotProfile, kind: str, names: list[str], units: str
) -> None:
    words = {"m": "metres", "r": "radians", "1": "unitless"}
    channels = {
        name: {"to": name, "unit": words[unit]} for name, unit in zip(names, units, strict=True)
    } | {"grip": {"to": "gripper_open", "unit": "closed_fraction"}}

    def without_state(config: dict[str, Any]) -> None:
        del config["input_features"]["observation.state"]
        config["output_features"]["action"]["shape"] = [len(channels)]

    folder = checkpoint(config=without_state)
    numbers = {f"action.{name}": np.ones(len(channels)) for name in ("mean", "std")}
    write_tensors(folder / UNNORMALIZER, numbers)
    given = {
        "checkpoint": folder,
        "rate_hz": 10,
        "space": kind,
        "names": [*names, "grip"],
        "channels": channels,
    }
    space = lerobot_space(given, robot)
    assert space.keys == (*names, "gripper_open")
    if kind == "ee_delta":
        assert {c.frame for c in space.channels[:6]} == {"base"}


def _without_steps(document: dict[str, Any]) -> None:
    document["steps"] = [s for s in document["steps"] if "normalizer" not in s["registry_name"]]


def _class_step(document: dict[str, Any]) -> None:
    document["steps"][0] = {"class": "evil.steps.Rename", "config": {}}


def _trusting(document: dict[str, Any]) -> None:
    document["steps"].append(
        {"registry_name": "action_tokenizer_processor", "config": {"trust_remote_code": True}}
    )


def _other_normalizer_mode(document: dict[str, Any]) -> None:
    document["steps"][-1]["config"]["norm_map"]["STATE"] = "LOG"


REFUSED: list[tuple[str, dict[str, Callable[[dict[str, Any]], None]], str]] = [
    ("act", {"policy_preprocessor": _class_step}, r"names the code of a step \(evil\.steps"),
    ("act", {"policy_preprocessor": _trusting}, r"asks for code from the hub \(trust_remote"),
    ("act", {"policy_preprocessor": _without_steps}, "has no step 'normalizer_processor'"),
    ("act", {"policy_preprocessor": _other_normalizer_mode}, "by the unknown mode 'LOG'"),
    ("act", {"config": lambda c: c.update(auto_map={"AutoModel": "x.Y"})}, r"\(auto_map\)"),
    ("act", {"config": lambda c: c.update(use_peft=True)}, "holds a PEFT adapter"),
    (
        "act",
        {"config": lambda c: c.update(use_relative_actions=True, n_obs_steps=2)},
        "relative actions of a policy that is queried row by row",
    ),
    (
        "act",
        {
            "config": lambda c: c["input_features"].update(
                {"observation.environment_state": {"type": "ENV", "shape": [6]}}
            )
        },
        r"takes 'observation\.environment_state' \(ENV, \[6\]\), which no robot",
    ),
    (
        "act",
        {"config": lambda c: c["output_features"].update(speech={"type": "ACTION", "shape": [1]})},
        "names the outputs action, speech",
    ),
    (
        "smolvla",
        {"config": lambda c: c.update(vlm_model_name="HuggingFaceTB/SmolVLM2-500M")},
        r"names HuggingFaceTB/SmolVLM2-500M \(vlm_model_name\), which is no folder",
    ),
    (
        "act",
        {"config": lambda c: c.update(some_new_encoder="acme/encoder-base")},
        r"names acme/encoder-base \(some_new_encoder\)",
    ),
]


@pytest.mark.parametrize(
    ("policy", "edits", "message"), REFUSED, ids=[row[2][:40] for row in REFUSED]
)
def test_a_checkpoint_is_refused_by_name(
    checkpoint: Make,
    options: Options,
    robot: RobotProfile,
    policy: str,
    edits: dict[str, Callable[[dict[str, Any]], None]],
    message: str,
) -> None:
    given = {**options, "checkpoint": checkpoint(policy, **edits)}
    with pytest.raises(CheckpointError, match=message):
        lerobot_space(given, robot)


def test_a_name_of_the_hub_is_no_folder(options: Options, robot: RobotProfile) -> None:
    with pytest.raises(CheckpointError, match="lerobot/act_aloha is no folder") as refusal:
        lerobot_space({**options, "checkpoint": "lerobot/act_aloha"}, robot)
    assert "download the checkpoint" in refusal.value.hint


def test_a_local_folder_stands_for_a_name_of_the_hub(
    checkpoint: Make, options: Options, tmp_path: Path
) -> None:
    folder = checkpoint(
        "smolvla", config=lambda c: c.update(vlm_model_name="HuggingFaceTB/SmolVLM2")
    )
    (tmp_path / "here").mkdir()
    given = {
        **options,
        "checkpoint": folder,
        "folders": {"HuggingFaceTB/SmolVLM2": tmp_path / "here"},
    }
    references = wire(LeRobotOptions.model_validate(given)).folder.references
    assert references["HuggingFaceTB/SmolVLM2"] == (tmp_path / "here").resolve()
    assert references["backbone"] == (folder / "backbone").resolve()


def test_code_in_the_folder_of_a_backbone_is_refused(checkpoint: Make, options: Options) -> None:
    folder = checkpoint("smolvla")
    (folder / "backbone" / "modeling.py").write_text("print('hello')")
    with pytest.raises(CheckpointError, match=r"backbone contains code \(modeling\.py\)"):
        wire(LeRobotOptions.model_validate({**options, "checkpoint": folder}))


@pytest.mark.parametrize("name", ["pytorch_model.bin", "model.pt"])
def test_pickled_weights_are_refused(checkpoint: Make, options: Options, name: str) -> None:
    folder = checkpoint()
    for path in folder.glob("*.safetensors"):
        path.unlink()
    (folder / name).write_bytes(b"\x80\x04.")
    with pytest.raises(CheckpointError, match=rf"weights as pickles \({name}\)"):
        wire(LeRobotOptions.model_validate({**options, "checkpoint": folder}))


@pytest.mark.parametrize("name", ["policy_preprocessor.json", "model.safetensors"])
def test_a_missing_file_is_named(checkpoint: Make, options: Options, name: str) -> None:
    folder = checkpoint()
    (folder / name).unlink()
    with pytest.raises(CheckpointError, match=name) as refusal:
        wire(LeRobotOptions.model_validate({**options, "checkpoint": folder}))
    if name.endswith("json"):
        assert "migrate_policy_normalization" in refusal.value.hint


@pytest.mark.parametrize(
    ("file", "key", "value", "message"),
    [
        (NORMALIZER, "observation.state.std", None, r"no statistic 'std' of 'observation\.state'"),
        (NORMALIZER, "observation.images.wrist.mean", None, r"'mean' of 'observation\.images\.wr"),
        (UNNORMALIZER, "action.mean", None, "no statistic 'mean' of 'action'"),
        (UNNORMALIZER, "action.mean", [0.0] * 6, "6 values as 'mean' of 'action', expected 8"),
        (UNNORMALIZER, "action.std", [np.nan] * 8, "expected 8 finite ones"),
    ],
)
def test_statistics_that_are_missing_are_named(
    checkpoint: Make, options: Options, file: str, key: str, value: Any, message: str
) -> None:
    """LeRobot itself continues without them, with numbers of another scale."""
    folder = checkpoint()
    tensors: dict[str, Any] = dict(read_tensors(folder / file))
    del tensors[key]
    if value is not None:
        tensors[key] = value
    write_tensors(folder / file, tensors)
    with pytest.raises(CheckpointError, match=message):
        wire(LeRobotOptions.model_validate({**options, "checkpoint": folder}))


def test_a_statistics_file_outside_of_the_checkpoint_is_not_read(
    checkpoint: Make, options: Options
) -> None:
    def outside(document: dict[str, Any]) -> None:
        document["steps"][-1]["state_file"] = "../secret.safetensors"

    folder = checkpoint(policy_preprocessor=outside)
    with pytest.raises(CheckpointError, match="names a file outside of its folder"):
        wire(LeRobotOptions.model_validate({**options, "checkpoint": folder}))


def test_a_damaged_statistics_file_is_refused(checkpoint: Make, options: Options) -> None:
    folder = checkpoint()
    whole = (folder / UNNORMALIZER).read_bytes()
    (folder / UNNORMALIZER).write_bytes(whole[:-40])
    with pytest.raises(CheckpointError, match=UNNORMALIZER):
        wire(LeRobotOptions.model_validate({**options, "checkpoint": folder}))


def test_a_camera_that_the_robot_lacks_is_named(
    checkpoint: Make, options: Options, robot: RobotProfile
) -> None:
    def renamed(config: dict[str, Any]) -> None:
        features = config["input_features"]
        features["observation.images.overhead"] = features.pop("observation.images.front")
        config["normalization_mapping"]["VISUAL"] = "IDENTITY"

    def plain(document: dict[str, Any]) -> None:
        document["steps"][-1]["config"]["norm_map"]["VISUAL"] = "IDENTITY"

    folder = checkpoint(config=renamed, policy_preprocessor=plain)
    given = {**options, "checkpoint": folder}
    with pytest.raises(
        ConfigurationError, match=r"overhead', and robot 'seven' has no camera"
    ) as e:
        lerobot_space(given, robot)
    assert "front (role primary)" in e.value.message
    assert lerobot_space({**given, "cameras": {"overhead": "primary"}}, robot).size == 8
    with pytest.raises(
        ConfigurationError, match=r"names observation\.images\.belly, which the policy"
    ):
        lerobot_space({**given, "cameras": {"belly": "primary"}}, robot)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joints": None}, "give either joints or channels"),
        ({"joint_unit": None}, "joints needs joint_unit"),
        ({"joints": [*ARM]}, "gripper_unit must be given exactly"),
        ({"rate_hz": 0}, "rate_hz"),
        ({"joints": [*ARM[:5], "gripper_open"]}, "has 8 values; 6 are named"),
        ({"joints": [*ARM[:6], "elbow", "gripper_open"]}, "mapped to elbow, which robot 'seven'"),
        ({"cameras": {"front": "wrist", "wrist": "wrist"}}, "names a role twice"),
        ({"surplus": 1}, "surplus"),
    ],
)
def test_options_that_do_not_fit_are_one_sentence(
    checkpoint: Make, options: Options, robot: RobotProfile, change: Options, message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message) as refusal:
        lerobot_space({**options, "checkpoint": checkpoint(), **change}, robot)
    assert "\n" not in refusal.value.message


@pytest.mark.parametrize("version", ["0.6.0", "0.5.1", "0.7.0", "1.0.0"])
def test_another_release_of_lerobot_is_refused(version: str) -> None:
    with pytest.raises(MissingDependencyError, match=f"LeRobot {version} is installed in"):
        check_release(version)


@pytest.mark.parametrize("version", ["0.6.1", "0.6.2", "0.6.10"])
def test_this_release_of_lerobot_is_taken(version: str) -> None:
    check_release(version)
