"""examples/pretrain_backbone.py: labels are true, and only the backbone of a checkpoint changes."""

from __future__ import annotations

import runpy
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import load_file

from rn_robot_fr3.profile import HOME_RAD

ROOT = Path(__file__).parents[4]


@pytest.fixture(scope="module")
def pretrain() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "examples" / "pretrain_backbone.py"))


def redness(picture: np.ndarray) -> np.ndarray:
    """Mask of the red pixels of an image (3, h, w)."""
    red, green, blue = picture.astype(int)
    return (red > 90) & (red > 2 * green) & (red > 2 * blue)


def test_the_wrist_sees_the_cube_where_its_label_says(pretrain: dict[str, Any]) -> None:
    poses = np.array([[*HOME_RAD, 1.0]])
    pictures, labels = pretrain["take_pictures"](poses, 48, np.random.default_rng(3))
    seen, told = [], []
    for picture, label in zip(pictures[:, 1], labels, strict=True):
        rows, columns = np.nonzero(redness(picture))
        free = label[2] < 0.03  # on the table, so that no finger occludes it
        if len(columns) > 8 and free and columns.min() > 0 and columns.max() < 95:
            seen.append([columns.mean(), rows.mean()])
            told.append(label[3:5])  # sideways of the TCP
    assert len(seen) > 12
    # a camera that looks straight down maps the table's plane linearly
    design = np.column_stack([told, np.ones(len(told))])
    _, residual, *_ = np.linalg.lstsq(design, np.array(seen), rcond=None)
    error_px = np.sqrt(residual / len(seen))
    assert error_px.max() < 4.0


def test_only_the_backbone_of_a_checkpoint_changes(
    pretrain: dict[str, Any], checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    shutil.copytree(checkpoints["act"], tmp_path / "act")
    before = load_file(tmp_path / "act" / "model.safetensors")
    sight = pretrain["Sight"]()
    pretrain["put_into"](tmp_path / "act", sight)
    after = load_file(tmp_path / "act" / "model.safetensors")
    assert after.keys() == before.keys()
    learnt = sight.backbone.state_dict()
    for name, value in after.items():
        own = name.removeprefix(pretrain["BACKBONE"])
        expected = learnt[own] if own != name else before[name]
        assert value.equal(expected), name


def test_a_checkpoint_with_another_backbone_is_refused(
    pretrain: dict[str, Any], checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    shutil.copytree(checkpoints["diffusion"], tmp_path / "diffusion")
    with pytest.raises(KeyError, match="no ResNet-18 as backbone"):
        pretrain["put_into"](tmp_path / "diffusion", pretrain["Sight"]())
