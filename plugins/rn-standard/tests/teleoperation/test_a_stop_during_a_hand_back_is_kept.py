"""A hand-back makes the policy begin anew, but not with an instruction that a stop has ended."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rn_standard.teleoperation.feature import Teleoperation
from roboneuron.feature import settings


class Cell:
    """A policy that follows `pick it up`; a stop ends that while the policy is told."""

    def __init__(self, *, is_stopped: bool) -> None:
        self.starts = SimpleNamespace(instruction="pick it up", ticket=3)
        self.told: list[str] = []
        self._is_stopped = is_stopped

    def set_parameters(
        self, kind: str, values: dict[str, str], answer_s: float, service_s: float
    ) -> str:
        self.told.append(values[settings.INSTRUCTION_PARAMETER])
        if self._is_stopped and len(self.told) == 1:
            self.starts.instruction, self.starts.ticket = "", 4
        return ""


@pytest.mark.parametrize(
    ("is_stopped", "told", "text"),
    [(False, ["pick it up"], "pick it up"), (True, ["pick it up", ""], "")],
)
def test_the_policy_keeps_what_is_valid_now(is_stopped: bool, told: list[str], text: str) -> None:
    cell, feature = Cell(is_stopped=is_stopped), Teleoperation(None)
    view = SimpleNamespace(phase="running")
    host: Any = SimpleNamespace(loop=cell, modules=SimpleNamespace(view=lambda kind: view))
    feature._host = host
    assert feature._begin_anew() == text
    assert cell.told == told
