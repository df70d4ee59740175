"""An application in this process without ROS, whose agents may choose."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rn_standard.selection.plugin import FEATURE
from rn_testing.fakes import fake_registry
from roboneuron.config import parse_config
from roboneuron.plugins.specs import BackendSpec
from roboneuron.server.app import Application


@pytest.fixture
def application(tmp_path: Path) -> Iterator[Application]:
    """The fakes and the feature as installed plugins; no ROS is touched until something is
    started.
    """
    config = parse_config(
        '[robot]\nname = "gantry"\n[perception]\nsource = "controlled"\n[inference]\nbackend = '
        '"instant"\n'
        '[control]\ncontroller = "gantry"\n'
    )
    heavy = BackendSpec(
        name="heavy", summary="Needs weights.", target="nowhere:Heavy", needs_checkpoint=True
    )
    registry = fake_registry(heavy, FEATURE)
    application = Application(
        config,
        plugins=lambda: registry,
        directory=tmp_path,
        command=lambda python: pytest.fail("nothing may be spawned"),
    )
    try:
        yield application
    finally:
        application.close()
