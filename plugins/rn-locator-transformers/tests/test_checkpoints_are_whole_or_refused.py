"""A folder that is not a whole checkpoint of a known family is refused before it is used."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file

from rn_locator_transformers.detector import load_detector
from roboneuron import CheckpointError

WEIGHTS = "model.safetensors"


def lose_a_weight(folder: Path) -> None:
    weights = load_file(folder / WEIGHTS)
    weights.pop(max(weights))
    save_file(weights, folder / WEIGHTS, metadata={"format": "pt"})


def shrink_a_weight(folder: Path) -> None:
    weights = load_file(folder / WEIGHTS)
    name = max(name for name, value in weights.items() if value.ndim == 2)
    weights[name] = weights[name][1:].contiguous()
    save_file(weights, folder / WEIGHTS, metadata={"format": "pt"})


def cut_the_weights(folder: Path) -> None:
    data = (folder / WEIGHTS).read_bytes()
    (folder / WEIGHTS).write_bytes(data[: len(data) // 2])


def pickle_the_weights(folder: Path) -> None:
    (folder / WEIGHTS).rename(folder / "pytorch_model.bin")


def change_config(**changes: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "config.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def garble(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).write_text("{")

    return change


DAMAGES = {
    "a weight is missing": lose_a_weight,
    "a weight has another shape": shrink_a_weight,
    "the file is cut": cut_the_weights,
    "weights are pickled": pickle_the_weights,
    "no config": remove("config.json"),
    "config is no JSON": garble("config.json"),
    "another model": change_config(model_type="bert"),
    "type of another type": change_config(model_type=["owlv2"]),
    "its backbone is elsewhere": change_config(use_pretrained_backbone=True),
    "no processor": remove("preprocessor_config.json"),
    "processor is no JSON": garble("preprocessor_config.json"),
    "tokenizer is no JSON": garble("tokenizer.json"),
}


@pytest.mark.parametrize(
    "family", ["owlv2", pytest.param("grounding-dino", marks=pytest.mark.exhaustive)]
)
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_refused(
    folders: dict[str, Path], tmp_path: Path, damage: str, family: str
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(folders[family], folder)
    DAMAGES[damage](folder)
    with pytest.raises(CheckpointError) as refused:
        load_detector(folder, "cpu")
    assert "copy" in str(refused.value)
    assert len(str(refused.value)) < 700
