"""Options that name hosts, files, commands or secrets are found by mark, type and name, however
deep they stand.
"""

from __future__ import annotations

from enum import StrEnum
from ipaddress import IPv4Address
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import AnyUrl, BaseModel, ConfigDict, Field, FilePath, SecretStr, create_model

from rn_testing.rules.restricted import unmarked_options
from roboneuron import AgentMaySet, ConfigurationOnly
from roboneuron.plugins.option_marks import SCHEMA_KEY
from roboneuron.selection.restricted import OptionAccess, restricted_values


class Colour(StrEnum):
    RED = "red"


class Camera(BaseModel):
    device: Annotated[str | None, ConfigurationOnly()] = None
    rate_hz: float = 10.0
    source: Annotated[str, Field(alias="from"), ConfigurationOnly()] = ""


class Other(BaseModel):
    topic: str = ""


class Options(BaseModel):
    model_config = ConfigDict(extra="forbid")

    gain: float = 1.0
    url: str = ""
    state_key: Annotated[str, AgentMaySet()] = ""
    weights: Annotated[Path, ConfigurationOnly()] | None = None
    front: Camera = Camera()
    cameras: dict[str, Camera | Other] = {}
    more: list[Camera] = []


FIELDS: list[tuple[str, Any, bool]] = [
    ("weights", Path, True),
    ("weights", Path | None, True),
    ("weights", tuple[Path, ...], True),
    ("weights", FilePath, True),
    ("page", AnyUrl, True),
    ("machine", IPv4Address, True),
    ("anything", Any, True),
    ("anything", dict[str, Any], True),
    ("anything", dict, True),
    ("pin", SecretStr, True),
    ("url", str, True),
    ("image_urls", list[str], True),
    ("api_key_variable", str | None, True),
    ("server_arguments", tuple[str, ...], True),
    ("environment", dict[str, str], True),
    ("host", Annotated[str, Field(min_length=1)], True),
    ("url", Literal["a", "b"], False),
    ("key", Colour, False),
    ("max_prompt_tokens", int, False),
    ("keyboard", str, False),
    ("profile", str, False),
    ("front", Camera, False),
    ("cameras", dict[str, Camera], False),
]


@pytest.mark.parametrize(
    ("name", "kind", "expected"), FIELDS, ids=[f"{f[0]}-{f[1]}" for f in FIELDS]
)
def test_type_and_name_tell_what_looks_restricted(name: str, kind: Any, expected: bool) -> None:
    model = create_model("Model", **{name: (kind, ...)})
    assert OptionAccess.of(name, model.model_fields[name]).looks_restricted is expected
    assert bool(unmarked_options(model)) is expected


def test_an_option_that_looks_restricted_has_to_be_marked() -> None:
    assert unmarked_options(Options) == ["Options.url"]


def test_restricted_values_are_found_in_tables_and_lists() -> None:
    given = {
        "gain": 2.0,
        "url": "http://x",
        "state_key": "k",
        "weights": "/w",
        "front": {"device": "/dev/video0", "rate_hz": 5.0},
        "cameras": {
            "left": {"rate_hz": 1.0},
            "right": {"from": "rtsp://x"},
            "top": {"topic": "/image"},
        },
        "more": [{"rate_hz": 3.0}, {"device": "/dev/mem"}],
    }
    assert restricted_values(Options, given) == {
        "url": "http://x",
        "weights": "/w",
        "front.device": "/dev/video0",
        "cameras.right.from": "rtsp://x",
        "more.1.device": "/dev/mem",
    }


def test_what_no_model_knows_counts_as_restricted() -> None:
    assert restricted_values(Options, {"front": {"devcie": 1}, "odd": 2}) == {
        "front.devcie": 1,
        "odd": 2,
    }
    assert restricted_values(Options, {"front": "front.toml"}) == {"front": "front.toml"}
    assert restricted_values(None, {"gain": 1.0}) == {"gain": 1.0}


def test_a_mark_stands_in_the_json_schema() -> None:
    entries = Camera.model_json_schema()["properties"]
    assert entries["device"][SCHEMA_KEY] is True
    assert SCHEMA_KEY not in entries["rate_hz"]
