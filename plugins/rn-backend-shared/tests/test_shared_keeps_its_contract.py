"""The contract of backends, kept by `shared` in front of a real server process."""

from __future__ import annotations

import pytest

from rn_backend_shared.case import shared_case
from rn_testing import BackendCase, BackendContract, PackageCase, PackageContract

pytestmark = pytest.mark.timeout(300)


class TestShared(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return shared_case()


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-backend-shared")
