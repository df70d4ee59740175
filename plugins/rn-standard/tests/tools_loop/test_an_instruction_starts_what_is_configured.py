"""Without the feature `selection`, a client starts what is configured, with its own instruction."""

from __future__ import annotations

from functools import partial

import pytest

from rn_standard.tools_loop.tools import StartInference, choose_instruction
from rn_testing.fakes import fake_registry
from roboneuron import Arguments, InternalError, NoArguments
from roboneuron.config import Config
from roboneuron.planning import Plan
from roboneuron.server.loop import choose_nothing

CONFIG = Config.model_validate(
    {
        "robot": {"name": "gantry"},
        "control": {"controller": "gantry"},
        "inference": {"backend": "instant", "instruction": "wait"},
    }
)


def _choose(kind: str, request: Arguments) -> Plan:
    choose = partial(choose_instruction, choose_nothing)
    return choose(kind, CONFIG, fake_registry(), request, "operator")


@pytest.mark.parametrize(
    ("request_", "instruction"),
    [
        (StartInference(), "wait"),
        (StartInference(instruction=" push the cube "), "push the cube"),
    ],
)
def test_the_instruction_of_a_request_comes_before_the_configured_one(
    request_: Arguments, instruction: str
) -> None:
    selection = _choose("inference", request_)
    assert selection.names["backend"] == "instant"
    assert selection.config.inference is not None
    assert selection.config.inference.instruction == instruction


def test_other_modules_are_started_as_configured() -> None:
    assert _choose("control", NoArguments()).names == {"controller": "gantry"}


def test_a_request_that_nobody_reads_is_not_ignored() -> None:
    class Foreign(Arguments):
        """Of a feature that is not there."""

    with pytest.raises(InternalError, match="cannot read the Foreign"):
        _choose("control", Foreign())
