"""Choices that cannot be: refused before anything is spawned, with a code, a message and what to
do.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, types

from roboneuron.server.app import Application


def call(application: Application, name: str, arguments: dict[str, Any]) -> types.CallToolResult:
    async def ask() -> types.CallToolResult:
        async with Client(application.server) as client:
            return await client.call_tool(name, arguments)

    return anyio.run(ask)


CASES: list[tuple[str, dict[str, Any], str, str]] = [
    (
        "start_robot",
        {"robto": "gantry"},
        "invalid_input",
        "no argument 'robto'. Did you mean 'robot'?",
    ),
    (
        "start_robot",
        {"robot": "fr3"},
        "invalid_input",
        "Argument 'robot' is 'fr3'. Choose one of: gantry.",
    ),
    ("start_robot", {"robot": 3}, "invalid_input", "Argument 'robot' is 3"),
    (
        "start_robot",
        {"driver": "hardware"},
        "unfit_combination",
        "has no driver 'hardware'; choose one of: simulated",
    ),
    (
        "start_robot",
        {"options": {"start_opne": True}},
        "configuration",
        "unknown key 'plugins.gantry.start_opne'",
    ),
    (
        "start_robot",
        {"options": {"start_open": "yes"}},
        "configuration",
        "plugins.gantry.start_open = 'yes'",
    ),
    ("start_perception", {"source": "webcam"}, "invalid_input", "Choose one of: controlled."),
    (
        "start_perception",
        {"cameras": ["front", "thermal"]},
        "invalid_input",
        "no camera 'thermal'. Its cameras: front",
    ),
    (
        "start_perception",
        {"cameras": "front"},
        "invalid_input",
        "'cameras' is 'front', expected a valid array",
    ),
    ("start_control", {"controller": "urdf"}, "invalid_input", "Choose one of: gantry."),
    ("start_inference", {"backend": "instnat"}, "invalid_input", "Did you mean 'instant'?"),
    (
        "start_inference",
        {"backend": "heavy"},
        "invalid_input",
        "Backend 'heavy' needs a checkpoint.",
    ),
    (
        "start_inference",
        {"backend": "heavy", "checkpoint": "/no/such"},
        "refused",
        "does not allow the checkpoint '/no",
    ),
    (
        "start_inference",
        {"checkpoint": "/tmp"},
        "checkpoint",
        "Backend 'instant' takes no checkpoint",
    ),
    ("start_inference", {"runtime": "counting"}, "unfit_combination", "takes no runtime"),
    (
        "start_inference",
        {"cameras": {"primary": "back"}},
        "unfit_combination",
        "Camera 'back' for role 'primary'",
    ),
    (
        "start_inference",
        {"options": {"horizon": 99}},
        "configuration",
        "plugins.instant.horizon = 99",
    ),
    ("start_inference", {"instruction": "   "}, "invalid_input", "The instruction is empty."),
    ("start_inference", {"instruction": "x" * 1001}, "invalid_input", "at most 1000 characters"),
]


@pytest.mark.parametrize(
    ("name", "arguments", "code", "words"), CASES, ids=[f"{c[0]}-{c[2]}-{c[3][:24]}" for c in CASES]
)
def test_a_bad_choice_is_refused_with_a_reason(
    application: Application, name: str, arguments: dict[str, Any], code: str, words: str
) -> None:
    answer = call(application, name, arguments)
    assert answer.is_error
    assert words in answer.content[0].text  # type: ignore[union-attr]
    assert answer.meta["roboneuron/error"]["code"] == code
    assert all(view.phase == "stopped" for view in application.supervisor.views())


def test_null_for_an_optional_argument_counts_as_omitted(
    application: Application, tmp_path: Path
) -> None:
    answer = call(
        application,
        "start_inference",
        {"backend": None, "checkpoint": str(tmp_path), "runtime": None},
    )
    assert answer.meta["roboneuron/error"]["code"] == "checkpoint"
