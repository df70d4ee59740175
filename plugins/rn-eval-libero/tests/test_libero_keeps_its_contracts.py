"""The backend keeps the contract of backends, and the package that of plugins."""

import pytest

from rn_eval_libero.plugin import roboneuron_backends
from rn_testing import BackendCase, BackendContract, PackageCase, PackageContract


class TestNoop(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return BackendCase(spec=roboneuron_backends()[0])


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-eval-libero")
