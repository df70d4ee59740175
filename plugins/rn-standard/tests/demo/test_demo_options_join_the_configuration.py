"""`roboneuron demo` adds seed and window to whatever the configuration says already."""

from __future__ import annotations

from pathlib import Path

import pytest

from rn_standard.demo.run import DemoOptions, write_configuration
from roboneuron.config import load_config
from roboneuron.errors import ConfigurationError

ROBOT = '[robot]\nname = "fr3"\ndriver = "simulated"\n'


def written(folder: Path, text: str, seed: int | None) -> Path:
    source = folder / "mine.toml"
    source.write_text(text, encoding="utf-8")
    return write_configuration(
        DemoOptions(
            instruction="pick up the red cube",
            seed=seed,
            gui=False,
            max_s=1.0,
            output=folder,
            config=source,
        ),
        folder,
    )


@pytest.mark.parametrize(
    ("plugins", "seed", "expected"),
    [
        ("", 3, {"seed": 3}),
        ('[plugins.fr3]\nengine = "mujoco"\n', 3, {"seed": 3, "engine": "mujoco"}),
        ("[plugins.fr3]\nseed = 5\n", None, {"seed": 5}),
    ],
)
def test_seed_is_added_to_the_options_of_the_file(
    tmp_path: Path, plugins: str, seed: int | None, expected: dict[str, object]
) -> None:
    assert load_config(written(tmp_path, ROBOT + plugins, seed)).plugins["fr3"] == expected


@pytest.mark.parametrize(
    ("plugins", "reason"),
    [
        ("[plugins.fr3]\nseed = 5\n", "seed"),
        ("[plugins]\nfr3 = {engine = 'mujoco'}\n", "form that cannot be added to"),
    ],
)
def test_seed_that_cannot_be_added_is_refused(tmp_path: Path, plugins: str, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        written(tmp_path, ROBOT + plugins, 3)
