"""The feature: tools of the arm among the exposed endpoints, recreated whenever these change."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron.contract import Pose
from roboneuron.contract.locator import LocatedObject
from roboneuron.modules.settings import ModuleKind
from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.tool import Tool
from roboneuron.tools.arm.grip_height import GripHeight
from roboneuron.tools.arm.measured import MeasuredPose
from roboneuron.tools.arm.options import ArmToolsOptions
from roboneuron.tools.arm.plugin import FEATURE
from roboneuron.tools.arm.tools import arm_tools


class ArmTools(Feature[ArmToolsOptions]):
    """Adds move_joints, move_ee and place. They need only the gate, which exposes the endpoints of
    the robot's profile.

    Attributes:
        poses, grips: measured TCPs and grippers, by "<namespace>/<arm>".
    """

    def __init__(self, options: ArmToolsOptions) -> None:
        super().__init__(options)
        self.poses: dict[str, MeasuredPose] = {}
        self.grips: dict[str, GripHeight] = {}
        self._namespace = ""

    def tools(self, host: Host) -> Sequence[Tool]:
        """Return no permanent tools; the derived ones appear once something is exposed."""
        poses, grips = self.poses, self.grips
        self._namespace = host.config.namespace

        def derive() -> None:
            host.tools.replace_derived(FEATURE.name, arm_tools(host, self.options, poses, grips))

        def watch(kind: ModuleKind) -> None:
            """Start watching the height at which the hand closes, once control starts, whatever
            command closes it.
            """
            if kind == "control" and host.modules.view("control").phase == "running":
                for grip in list(grips.values()):
                    grip.watch()

        host.events.change.listen(watch)
        host.events.exposed.listen(derive)
        derive()
        return ()

    def fastest_m_s(self, since_s: float) -> float | None:
        """Highest speed of a TCP since a monotonic time [s], as measured [m/s]; None if not."""
        speeds = [pose.speeds.fastest_since(since_s) for pose in list(self.poses.values())]
        return max((speed for speed in speeds if speed is not None), default=None)

    def held_at(self, arm: str, pose: Pose) -> LocatedObject | None:
        """What the hand of an arm of the present robot holds, with its TCP at a pose; None if pick
        did not grasp it.
        """
        grip = self.grips.get(f"{self._namespace}/{arm}")
        return None if grip is None or grip.held is None else grip.held.at(pose)
