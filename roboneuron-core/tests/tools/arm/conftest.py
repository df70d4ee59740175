"""The cell of the tests of hands."""

from __future__ import annotations

from typing import Any

import pytest
from handling_cell import Cell, cube

from roboneuron import RefusedError
from roboneuron.tools.arm import bounds, doubt, picking, place_plans


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Cell:
    made = Cell(cube("red", 0.5), cube("green", 0.5, 0.12), cube("blue", 0.45, -0.15))

    def rehearse(mover: Any, route: Any, speed: float) -> float:
        if not made.is_reachable:
            raise RefusedError("The elbow would stretch.", rule="path")
        return 1.0

    for module in (picking, place_plans, bounds, doubt):
        monkeypatch.setattr(module, "rehearse", rehearse)
    return made
