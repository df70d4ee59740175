"""The command keeps the contract of commands, the suites that of suites, and the package that of
plugins.
"""

import pytest

from rn_eval.contract_cases import SuiteCase, cubes_case, hand_over_case
from rn_eval.hooks import SuiteSpec
from rn_testing.contracts import contract_of


class TestCubes(contract_of(SuiteSpec)):
    @pytest.fixture
    def plugin(self) -> SuiteCase:
        return cubes_case()


class TestHandOver(contract_of(SuiteSpec)):
    @pytest.fixture
    def plugin(self) -> SuiteCase:
        return hand_over_case()
