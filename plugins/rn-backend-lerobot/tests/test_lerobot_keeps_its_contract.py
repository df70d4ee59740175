"""The contract kit: the package in this environment, the backend in LeRobot's."""

from __future__ import annotations

import functools

import pytest

from rn_testing import BackendCase, BackendContract
from roboneuron.plugins.availability import is_importable


@functools.cache
def _case() -> BackendCase:
    from rn_backend_lerobot.case import lerobot_case  # heavy

    return lerobot_case()


@pytest.mark.skipif(
    not is_importable("lerobot"),
    reason="LeRobot is in an environment of its own: make test-lerobot-policies",
)
class TestLeRobot(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return _case()
