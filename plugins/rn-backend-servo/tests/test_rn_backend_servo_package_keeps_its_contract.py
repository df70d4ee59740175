"""The package keeps the contract of packages."""

import pytest

from rn_testing import PackageCase, PackageContract


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-backend-servo")
