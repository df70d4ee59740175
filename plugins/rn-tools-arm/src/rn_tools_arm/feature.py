"""The feature: tools of the arm among what is exposed, made again whenever that changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rn_direct_path.feature import gate_of
from rn_tools_arm.measured import MeasuredPose
from rn_tools_arm.options import ArmToolsOptions
from rn_tools_arm.plugin import FEATURE
from rn_tools_arm.tools import arm_tools
from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.tool import Tool


class ArmTools(Feature[ArmToolsOptions]):
    """move_joints and move_ee. They need the gate only, which exposes the endpoints of the robot's profile."""

    def tools(self, host: Host) -> Sequence[Tool[Any]]:
        """None but the derived ones, which come once something is exposed."""

        poses: dict[str, MeasuredPose] = {}

        def derive() -> None:
            host.tools.replace_derived(FEATURE.name, arm_tools(host, self.options, poses))

        gate_of(host).on_change(derive)
        derive()
        return ()
