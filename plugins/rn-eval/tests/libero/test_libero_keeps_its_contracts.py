"""Backend and suites keep the contracts of their kinds, and the package that of plugins."""

import pytest

from rn_eval.contract_cases import SuiteCase
from rn_eval.hooks import SuiteSpec
from rn_eval.libero.plugin import roboneuron_backends, roboneuron_suites
from rn_testing import BackendCase, BackendContract
from rn_testing.contracts import contract_of


class TestNoop(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return BackendCase(spec=roboneuron_backends()[0])


class TestSuites(contract_of(SuiteSpec)):
    @pytest.fixture(params=roboneuron_suites(), ids=lambda spec: spec.name)
    def plugin(self, request: pytest.FixtureRequest) -> SuiteCase:
        """Rules that open a scene are skipped without the simulator's environment."""
        return SuiteCase(spec=request.param, is_automatic=True)
