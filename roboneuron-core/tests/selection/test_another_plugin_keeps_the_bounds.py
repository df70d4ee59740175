"""A client that names another plugin loosens none of the configured timeouts and bounds."""

from __future__ import annotations

from typing import Any

import pytest

from rn_testing.fakes import fake_registry
from roboneuron import BackendSpec, ControllerSpec, PerceptionSpec, Section
from roboneuron.config import parse_config
from roboneuron.config.models import ModuleKind
from roboneuron.selection.choosing import choose
from roboneuron.selection.requests import REQUESTS

REGISTRY = fake_registry(
    BackendSpec(name="other", summary="Another policy.", target="nowhere:X"),
    ControllerSpec(name="other", summary="Another controller.", target="nowhere:X"),
    PerceptionSpec(name="other", summary="Another source.", target="nowhere:X"),
)
CONFIGURATION = """
[robot]
name = "gantry"
[perception]
source = "controlled"
cameras = ["front"]
start_timeout_s = 7.0
[inference]
backend = "instant"
instruction = "wave"
fallback = "instant"
max_image_age_s = 0.25
max_tail_age_s = 0.4
execution = "sequential"
switch_max_difference = 0.1
start_timeout_s = 7.0
[control]
controller = "gantry"
action_timeout_s = 0.3
state_timeout_s = 0.1
server_timeout_s = 1.0
command = "joint_state"
switch_max_difference = 0.01
start_timeout_s = 7.0
[models.far]
backend = "other"
"""
KEPT: list[tuple[ModuleKind, dict[str, Any], dict[str, Any]]] = [
    (
        "inference",
        {"backend": "other"},
        {
            "fallback": "instant",
            "max_image_age_s": 0.25,
            "max_tail_age_s": 0.4,
            "execution": "sequential",
            "switch_max_difference": 0.1,
        },
    ),
    (
        "control",
        {"controller": "other"},
        {
            "action_timeout_s": 0.3,
            "state_timeout_s": 0.1,
            "server_timeout_s": 1.0,
            "command": "joint_state",
            "switch_max_difference": 0.01,
        },
    ),
]


def chosen(kind: ModuleKind, request: dict[str, Any]) -> Section:
    config = parse_config(CONFIGURATION)
    made = choose(kind, config, REGISTRY, REQUESTS[kind](**{"options": {}, **request}))
    section: Section = getattr(made.config, kind)
    return section


@pytest.mark.parametrize(("kind", "request_", "kept"), KEPT)
def test_timeouts_and_bounds_stay_as_configured(
    kind: ModuleKind, request_: dict[str, Any], kept: dict[str, Any]
) -> None:
    section = chosen(kind, request_)
    assert {key: getattr(section, key) for key in kept} == kept


def test_they_stay_for_a_named_model() -> None:
    section = chosen("inference", {"model": "far"})
    kept = KEPT[0][2]
    assert {key: getattr(section, key) for key in kept} == kept


@pytest.mark.parametrize(
    ("kind", "request_", "default"),
    [
        ("perception", {"source": "other"}, {"cameras": (), "start_timeout_s": None}),
        ("inference", {"backend": "other"}, {"instruction": "", "start_timeout_s": None}),
        ("control", {"controller": "other"}, {"start_timeout_s": None}),
    ],
)
def test_what_is_meant_for_the_configured_plugin_is_not_taken(
    kind: ModuleKind, request_: dict[str, Any], default: dict[str, Any]
) -> None:
    section = chosen(kind, request_)
    assert {key: getattr(section, key) for key in default} == default
