"""Every rule of the contract kit for controllers, on the controller "urdf" and the kit's own
arm.
"""

from __future__ import annotations

import pytest

from rn_controller_urdf.plugin import roboneuron_controllers
from rn_testing import ControllerCase, ControllerContract


class TestUrdfController(ControllerContract):
    @pytest.fixture
    def plugin(self) -> ControllerCase:
        (spec,) = roboneuron_controllers()
        return ControllerCase(spec=spec)
