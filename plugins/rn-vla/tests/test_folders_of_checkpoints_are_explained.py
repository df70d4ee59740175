"""A folder that is no checkpoint is named for what it is, with one thing that works."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel

from rn_vla.checkpoint_files import check_file, read_schema
from roboneuron import CheckpointError


class Config(BaseModel):
    """A config.json."""

    type: str
    width: int


def hint(folder: Path) -> str:
    with pytest.raises(CheckpointError) as caught:
        check_file(folder / "config.json")
    return caught.value.hint


@pytest.mark.parametrize(
    "inner",
    [
        "pretrained_model",
        "checkpoints/last/pretrained_model",
        "checkpoints/020000/pretrained_model",
        "020000/pretrained_model",
        "snapshots/0a1b2c",
        "smolvla_base",
    ],
)
def test_the_folder_inside_is_named(inner: str, tmp_path: Path) -> None:
    (tmp_path / inner).mkdir(parents=True)
    (tmp_path / inner / "config.json").write_text("{}")
    assert str(tmp_path / inner) in hint(tmp_path)


def test_a_checkpoint_of_openpi_in_jax_is_named(tmp_path: Path) -> None:
    (tmp_path / "params").mkdir()
    (tmp_path / "params" / "_METADATA").write_text("{}")
    (tmp_path / "assets").mkdir()
    assert "JAX" in hint(tmp_path)
    assert "convert_jax_model_to_pytorch" in hint(tmp_path)


def test_other_folders_are_listed(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("")
    assert "notes.txt" in hint(tmp_path)
    assert "no folder" in hint(tmp_path / "absent")
    (tmp_path / "empty").mkdir()
    assert "nothing" in hint(tmp_path / "empty")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"type": null, "width": 1}', "No backend of RoboNeuron runs that family"),
        ('{"width": 1}', "No backend of RoboNeuron runs that family"),
        ('{"type": "pi0", "width": "wide"}', "Compare config.json"),
    ],
)
def test_what_a_config_lacks_has_a_hint_that_fits(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(CheckpointError) as caught:
        read_schema(tmp_path / "config.json", Config)
    assert words in caught.value.hint
    assert "again" not in caught.value.hint
