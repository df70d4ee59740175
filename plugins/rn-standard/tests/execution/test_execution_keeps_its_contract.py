"""The feature keeps the contract of features, and its package that of plugins; modules get its
executor.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rn_standard.execution.adaptive import AdaptiveExecutor
from rn_standard.execution.feature import join
from rn_standard.execution.plugin import FEATURE
from rn_standard.inference.execution import Bounds, ExecutorMaker, executor_maker
from rn_testing import FeatureCase, FeatureContract, PackageCase, PackageContract
from roboneuron import ActionSpace, BackendSpec
from roboneuron.errors import ConfigurationError

BACKEND = BackendSpec(
    name="plain", summary="x", target="x:X", action_space=ActionSpace(step_s=0.05)
)
BOUNDS = Bounds(first_s=0.5)


def _joined() -> Any:
    """A module that the feature has joined."""
    parts: list[object] = []
    host: Any = SimpleNamespace(provide=parts.append, provided=lambda kind: parts[0])
    join(host)
    assert isinstance(parts[0], ExecutorMaker)
    return host


class TestExecution(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-standard", plugin="rn-execution")


def test_a_module_that_joins_gets_the_executor_of_this_package() -> None:
    host = _joined()
    made = executor_maker(host).make(BACKEND, "overlap", BOUNDS)
    assert isinstance(made, AdaptiveExecutor)
    assert made.values()["mode"] == "overlap"


@pytest.mark.parametrize("mode", ["rtc", "predicted-state"])
def test_a_mode_that_the_backend_cannot_do_is_refused(mode: str) -> None:
    host = _joined()
    with pytest.raises(ConfigurationError, match=f"{mode!r}, which backend 'plain' cannot do"):
        executor_maker(host).make(BACKEND, mode, BOUNDS)
