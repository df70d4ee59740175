"""The contract of backends, kept by `shared` with a real server process, and those of its
commands.
"""

from __future__ import annotations

import pytest

from rn_backend_openpi.shared_case import shared_case
from rn_testing import (
    BackendCase,
    BackendContract,
)

pytestmark = pytest.mark.timeout(300)


class TestShared(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return shared_case()
