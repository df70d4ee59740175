"""The contract of packages for rn-perception."""

from __future__ import annotations

import pytest

from rn_testing import PackageCase, PackageContract


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-standard", plugin="rn-perception")
