"""The feature keeps the contract of features, and its package that of plugins; modules get its
executor.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rn_testing import FeatureCase, FeatureContract
from roboneuron import ActionSpace, BackendSpec
from roboneuron.errors import ConfigurationError
from roboneuron.modules.execution.adaptive import AdaptiveExecutor
from roboneuron.modules.execution.feature import join
from roboneuron.modules.execution.plugin import FEATURE
from roboneuron.modules.inference.execution import (
    Bounds,
    ChunkExecutor,
    executor_of,
)
from roboneuron.modules.step_filters import StepFilter, StepFilters

BACKEND = BackendSpec(
    name="plain", summary="x", target="x:X", action_space=ActionSpace(step_s=0.05)
)
BOUNDS = Bounds(first_s=0.5)


def _joined() -> Any:
    """A module that the feature has joined."""
    host: Any = SimpleNamespace(filters=[])
    join(host)
    return host


class TestExecution(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE)


def test_a_module_that_joins_gets_the_executor_of_this_package() -> None:
    host = _joined()
    made = executor_of(host.filters, BACKEND, "overlap", BOUNDS)
    assert isinstance(made, AdaptiveExecutor)
    assert made.values()["mode"] == "overlap"


def test_a_clock_s_executor_takes_the_place_of_any_other() -> None:
    host = _joined()
    made = ChunkExecutor(BOUNDS)

    class Stepped(StepFilter):
        phase = StepFilter.StepPhase.CLOCK

        def executor(self, *_: object) -> ChunkExecutor:
            return made

    host.filters.append(Stepped())
    assert executor_of(StepFilters(host.filters), BACKEND, "overlap", BOUNDS) is made


@pytest.mark.parametrize("mode", ["rtc", "predicted-state"])
def test_a_mode_that_the_backend_cannot_do_is_refused(mode: str) -> None:
    host = _joined()
    with pytest.raises(ConfigurationError, match=f"{mode!r}, which backend 'plain' cannot do"):
        executor_of(host.filters, BACKEND, mode, BOUNDS)
