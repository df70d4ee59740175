"""An application in this process that serves stdio, without ROS."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from roboneuron.server.app import Application
from roboneuron.stdio.plugin import FEATURE


@pytest.fixture
def application(application_of: Callable[..., Application]) -> Application:
    """The fakes and this feature."""
    return application_of(FEATURE)
