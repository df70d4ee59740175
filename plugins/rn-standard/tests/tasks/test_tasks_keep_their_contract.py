"""The feature, its monitors and its package keep their contracts."""

import pytest

from rn_standard.tasks.contract_cases import CASES, MonitorCase
from rn_standard.tasks.hooks import MonitorSpec
from rn_standard.tasks.plugin import FEATURE
from rn_testing import FeatureCase, FeatureContract
from rn_testing.contracts import contract_of
from roboneuron.selection.plugin import FEATURE as SELECTION


class TestTasks(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(
            spec=FEATURE,
            needs=(SELECTION,),
            options={"postures": {"rest": {"joints": {"joint1": 0.1}}}, "tasks": {"max_s": 30.0}},
        )


class TestMonitors(contract_of(MonitorSpec)):
    @pytest.fixture(params=CASES, ids=lambda make: make.__name__)
    def plugin(self, request: pytest.FixtureRequest) -> MonitorCase:
        return request.param()
