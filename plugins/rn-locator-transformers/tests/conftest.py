"""Tiny checkpoints of both families, made once for all tests."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from rn_locator_transformers.tiny import FAMILIES, make_tiny

SEEDS = {"owlv2": 4, "grounding-dino": 0}
"""Whose boxes are places on the table, and of more than one label."""
torch.set_num_threads(1)  # several tests share the cores


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    made = {family: tmp_path_factory.mktemp("tiny") / family for family in FAMILIES}
    for family, folder in made.items():
        make_tiny(folder, family, seed=SEEDS[family])
    return made
