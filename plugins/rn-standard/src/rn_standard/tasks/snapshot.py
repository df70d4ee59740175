"""Input of predicates: the measured state of the robot at one moment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from roboneuron import ArmState, Frame, JointKinds, Observation, Pose


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmSnapshot:
    """One of several arms; unmeasured values are None.

    Attributes:
        tcp: pose of its TCP in the base frame.
        gripper_open: 0 closed .. 1 open.
    """

    tcp: Pose | None = None
    gripper_open: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Snapshot:
    """State at one moment; unmeasured values are None or absent.

    Attributes:
        now_s: monotonic time [s].
        joints: position by joint [rad or m].
        effort: effort by joint [Nm or N], for joints with measured effort.
        tcp: pose of the TCP in the base frame; of the first arm.
        gripper_open: 0 closed .. 1 open; of the first arm.
        arms: each of several arms by its name.
        still_s: time since a joint last moved [s].
        policy_done: the policy's report of its own end; None without one.
        frames: newest image by role of the camera.
        messages: newest message by topic, for those in predicates.
    """

    now_s: float
    joints: Mapping[str, float] | None = None
    effort: Mapping[str, float] = field(default_factory=dict)
    tcp: Pose | None = None
    gripper_open: float | None = None
    arms: Mapping[str, ArmSnapshot] = field(default_factory=dict)
    still_s: float | None = None
    policy_done: bool | None = None
    frames: Mapping[str, Frame] = field(default_factory=dict)
    messages: Mapping[str, object] = field(default_factory=dict)

    def of_arm(self, name: str) -> ArmSnapshot:
        """State of an arm, without measurements for an unknown one; with "" the first."""
        if not name:
            return ArmSnapshot(tcp=self.tcp, gripper_open=self.gripper_open)
        return self.arms.get(name, ArmSnapshot())

    def observation(self, instruction: str) -> Observation:
        """The observation for a monitor."""
        stamp_ns = min((frame.stamp_ns for frame in self.frames.values()), default=0)
        return Observation(
            frames=self.frames,
            instruction=instruction,
            ee_pose=self.tcp,
            gripper_open=self.gripper_open,
            arms={
                name: ArmState(ee_pose=arm.tcp, gripper_open=arm.gripper_open)
                for name, arm in self.arms.items()
                if arm.tcp is not None
            },
            stamp_ns=stamp_ns,
        )


class StillClock:
    """Time without motion of any joint.

    Args:
        least: displacement that counts as motion [rad or m].
        kinds: of the joints of the robot; None if it has no description.
    """

    def __init__(self, least: float = 0.002, kinds: JointKinds | None = None) -> None:
        self._least, self._kinds = least, kinds or JointKinds.of("")
        self._anchor: dict[str, float] = {}
        self._since_s = 0.0

    def observe(self, now_s: float, joints: Mapping[str, float]) -> float:
        """Add measured positions; return the time since the last motion [s]."""
        moved = self._anchor.keys() != joints.keys() or any(
            abs(self._kinds.difference(name, place, joints[name])) > self._least
            for name, place in self._anchor.items()
        )
        if moved:
            self._anchor, self._since_s = dict(joints), now_s
        return now_s - self._since_s
