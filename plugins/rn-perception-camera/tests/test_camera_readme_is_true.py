"""The configurations and the option tables of this package's README are those of the code."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from rn_perception_camera.options import RosCameraOptions, VideoCameraOptions
from rn_perception_camera.plugin import roboneuron_perceptions
from roboneuron.plugins.loading import load_options

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
BLOCKS = [tomllib.loads(block) for block in re.findall(r"```toml\n(.*?)```", README, re.DOTALL)]


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block["perception"]["source"])
def test_configurations_are_accepted(block: dict[str, Any]) -> None:
    source = block["perception"]["source"]
    spec = next(spec for spec in roboneuron_perceptions() if spec.name == source)
    options = block["plugins"][source]
    assert load_options(spec, options) is not None
    assert list(options["cameras"]) == block["perception"]["cameras"]


def test_every_option_is_described() -> None:
    for heading, model in (
        ("`ros-camera`", RosCameraOptions),
        ("`video-camera`", VideoCameraOptions),
    ):
        section = README[README.index(heading, README.index("## ")) :].partition("\n## ")[0]
        rows = {
            word
            for row in re.findall(r"^\| (`.*?) \|", section, re.MULTILINE)
            for word in re.findall(r"`(\w+)`", row)
        }
        assert rows == set(model.model_fields)
