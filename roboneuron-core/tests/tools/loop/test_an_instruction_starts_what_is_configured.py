"""Without the feature `selection`, a client starts what is configured, with its own instruction."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rn_testing.fakes import fake_registry
from roboneuron import Arguments, InternalError, NoArguments
from roboneuron.config import Config
from roboneuron.server.loop import ClosedLoop
from roboneuron.supervisor.supervisor import Supervisor
from roboneuron.tools.loop.tools import INSTRUCTION, StartInference

CONFIG = Config.model_validate(
    {
        "robot": {"name": "gantry"},
        "control": {"controller": "gantry"},
        "inference": {"backend": "instant", "instruction": "wait"},
    }
)


@pytest.fixture
def loop(tmp_path: Path) -> Iterator[ClosedLoop]:
    supervisor = Supervisor(tmp_path)
    made = ClosedLoop(CONFIG, fake_registry, supervisor)
    made.accept([INSTRUCTION])
    yield made
    supervisor.close()


@pytest.mark.parametrize(
    ("request_", "instruction"),
    [
        (None, "wait"),
        (StartInference(), "wait"),
        (StartInference(instruction=None), "wait"),
        (StartInference(instruction=" push the cube "), "push the cube"),
    ],
)
def test_the_instruction_of_a_request_comes_before_the_configured_one(
    loop: ClosedLoop, request_: Arguments | None, instruction: str
) -> None:
    selection = loop.select("inference", request_, "operator")
    assert selection.names["backend"] == "instant"
    assert selection.config.inference is not None
    assert selection.config.inference.instruction == instruction


def test_other_modules_are_started_as_configured(loop: ClosedLoop) -> None:
    assert loop.select("control", NoArguments(), "operator").names == {"controller": "gantry"}


def test_a_request_that_nobody_reads_is_not_ignored(loop: ClosedLoop) -> None:
    class Foreign(Arguments):
        """Of a feature that is not there."""

        speed: str

    with pytest.raises(InternalError, match="cannot read the Foreign"):
        loop.select("control", Foreign(speed="fast"), "operator")
