from __future__ import annotations

import pytest

from rn_backend_openvla.case import openvla_case, openvla_tcp_case
from rn_testing import BackendCase, BackendContract


class TestOpenVla(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return openvla_case()


@pytest.mark.sampled(every=4)
class TestOpenVlaTcp(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return openvla_tcp_case()
