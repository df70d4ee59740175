"""The installed physics engines; tests of the simulation run in each of them."""

from __future__ import annotations

import pytest

from rn_simulation.engine import ENGINES, Engine
from roboneuron.plugins.availability import is_importable


@pytest.fixture(params=[engine for engine in ENGINES if is_importable(engine)])
def engine(request: pytest.FixtureRequest) -> Engine:
    return request.param  # type: ignore[no-any-return]
