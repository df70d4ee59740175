"""Options of pydantic models as `plugins show` and the configuration's reference print them."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field

from rn_standard.console.options import UNSET, Option, describe_options


class Corner(BaseModel):
    x: float = Field(description="[m]")


class Everything(BaseModel):
    fast: bool = False
    sizes: tuple[int, ...] = (1, 2)
    folder: Path = Path("a/b")
    mode: Literal["warm", "cold"] = "warm"
    rate: float = Field(gt=0, le=60, description="per second")
    corner: Corner | None = None
    corners: tuple[Corner, ...] = ()
    named: Mapping[str, Corner] = Field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = Field(
        default_factory=lambda: {"linear.x": (-0.5, 1e-7)}
    )
    name: str | None = None
    text: str = 'a "b" \\ \n ü'


def test_defaults_are_written_as_toml_and_types_with_their_bounds() -> None:
    options = {option.key: option for option in describe_options(Everything)}
    assert options["fast"] == Option(key="fast", type="boolean", default="false", meaning="")
    assert options["sizes"].default == "[1, 2]"
    assert options["folder"].default == '"a/b"'
    assert (options["mode"].type, options["mode"].default) == ("`warm` or `cold`", '"warm"')
    assert options["name"].default == UNSET
    assert options["rate"] == Option(
        key="rate", type="number > 0, ≤ 60", default=None, meaning="per second"
    )


def test_every_default_is_read_back_by_a_toml_parser() -> None:
    default = Everything(rate=1.0).model_dump(mode="json")
    options = [
        o
        for o in describe_options(Everything)
        if o.default not in (None, UNSET) and "<" not in o.key
    ]
    assert {o.key for o in options} >= {
        "fast",
        "sizes",
        "folder",
        "mode",
        "named",
        "bounds",
        "text",
    }
    for option in options:
        assert tomllib.loads(f"value = {option.default}")["value"] == default[option.key]


def test_what_a_table_holds_follows_it() -> None:
    keys = [option.key for option in describe_options(Everything)]
    assert keys[5:11] == ["corner", "corner.x", "corners", "corners[].x", "named", "named.<name>.x"]
    assert next(o for o in describe_options(Everything) if o.key == "corner.x").meaning == "[m]"
