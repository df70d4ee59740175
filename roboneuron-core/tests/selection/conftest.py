"""An application in this process without ROS, whose agents may choose."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from roboneuron.plugins.specs import BackendSpec
from roboneuron.selection.plugin import FEATURE
from roboneuron.server.app import Application


@pytest.fixture
def application(application_of: Callable[..., Application]) -> Application:
    """The fakes and the feature as installed plugins."""
    text = (
        '[robot]\nname = "gantry"\n[perception]\nsource = "controlled"\n[inference]\nbackend = '
        '"instant"\n'
        '[control]\ncontroller = "gantry"\n'
    )
    heavy = BackendSpec(
        name="heavy", summary="Needs weights.", target="nowhere:Heavy", needs_checkpoint=True
    )
    return application_of(heavy, FEATURE, text=text)
