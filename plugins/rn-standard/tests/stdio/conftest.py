"""An application in this process that serves stdio, without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rn_standard.stdio.plugin import FEATURE
from rn_testing.fakes import fake_registry
from roboneuron.config import Config
from roboneuron.server.app import Application


@pytest.fixture
def application(tmp_path: Path) -> Iterator[Application]:
    """The fakes as installed plugins; no ROS is touched until something is started."""
    registry = fake_registry(FEATURE)
    application = Application(
        Config.model_validate({"robot": {"name": "gantry"}}),
        plugins=lambda: registry,
        directory=tmp_path,
        command=lambda python: pytest.fail("nothing may be spawned"),
    )
    try:
        yield application
    finally:
        application.close()
