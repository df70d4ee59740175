"""LeRobot's arms as data: joints, limits, postures, and what stands around them. All have the
joints of the SO-101.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.resources import files
from xml.etree import ElementTree

import numpy as np

from roboneuron import JointLimits, Obstacle, Workspace

ARM_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
"""Names of the arm's joints, base to tip: those of LeRobot's motors."""
GRIPPER_JOINT = "gripper"
"""The moving jaw, which turns."""
JOINTS = (*ARM_JOINTS, GRIPPER_JOINT)
"""Every joint, in the order of all joint arrays of this package and of the motors' numbers 1..6."""
Point = tuple[float, float, float]
FIVE = tuple[float, float, float, float, float]


@dataclass(frozen=True, kw_only=True, slots=True)
class LerobotArm:
    """One kind of arm; numbers of joints in the order of `ARM_JOINTS`.

    Attributes:
        name: of the robot, and of its URDF in `data`.
        base_link, tcp_link, jaw_links: of the URDF.
        lower_rad, upper_rad: position limits.
        effort_nm: of the motors.
        jaw_closed_rad, jaw_open_rad: positions of the gripper's joint.
        home_rad: gripper down, above what it works on.
        workspace_m: lowest and highest corner for the TCP; at the lowest height the tips of the
            jaws, 8 mm beyond the TCP, are still above the ground.
        ground: what the arm stands on, and what is below it.
        carried: the arm whose links are joined to those of the URDF.
        velocity_rad_s, acceleration_rad_s2: of every joint. The first is two thirds of the speed of
            an SO-101's motors without load and half of that of a Koch arm's; the second is an
            estimate, as LeRobot has the motors accelerate as fast as they can.
        jaw_effort_nm: LeRobot limits the gripper's motor; this is 6 N at the tip.
    """

    name: str
    base_link: str
    tcp_link: str
    jaw_links: tuple[str, ...]
    lower_rad: FIVE
    upper_rad: FIVE
    effort_nm: FIVE
    jaw_closed_rad: float
    jaw_open_rad: float
    home_rad: FIVE
    workspace_m: tuple[Point, Point]
    ground: Obstacle
    carried: LerobotArm | None = None
    velocity_rad_s: float = 3.0
    acceleration_rad_s2: float = 20.0
    jaw_effort_nm: float = 0.5

    def urdf(self) -> str:
        """XML text: published kinematics and limits, shapes of boxes, no mesh files."""
        path = files("rn_robot_lerobot").joinpath(f"data/{self.name}.urdf")
        text = path.read_text(encoding="utf-8")
        if self.carried is None:
            return text
        whole = ElementTree.fromstring(text)
        whole.extend(ElementTree.fromstring(self.carried.urdf()))
        return ElementTree.tostring(whole, encoding="unicode")

    def joint_limits(self) -> JointLimits:
        """The limits of the arm's joints."""
        one = np.ones(len(ARM_JOINTS))
        return JointLimits(
            lower=np.array(self.lower_rad),
            upper=np.array(self.upper_rad),
            velocity=self.velocity_rad_s * one,
            acceleration=self.acceleration_rad_s2 * one,
            effort=np.array(self.effort_nm),
        )

    def workspace(self) -> Workspace:
        """Where the TCP may be, in the base frame."""
        lower_m, upper_m = map(np.array, self.workspace_m)
        return Workspace(lower_m=lower_m, upper_m=upper_m)

    def start_rad(self) -> np.ndarray:
        """At home with an open gripper, float64 (6,), in the order of `JOINTS`."""
        return np.array((*self.home_rad, self.jaw_open_rad))

    def ends_rad(self) -> list[tuple[float, float]]:
        """Lowest and highest position of each of `JOINTS`."""
        jaw = self.jaw_closed_rad, self.jaw_open_rad
        return [*zip(self.lower_rad, self.upper_rad, strict=True), jaw]


TABLE = Obstacle(
    name="table", lower_m=np.array((-0.20, -0.40, -0.60)), upper_m=np.array((0.50, 0.40, 0.00))
)
SO101 = LerobotArm(
    name="so101",
    base_link="so101_base",
    tcp_link="so101_tcp",
    jaw_links=("so101_gripper", "so101_moving_jaw"),
    lower_rad=(-1.91986, -1.74533, -1.69, -1.65806, -2.74385),
    upper_rad=(1.91986, 1.74533, 1.69, 1.65806, 2.84121),
    effort_nm=(1.9, 1.9, 1.9, 1.9, 1.9),
    jaw_closed_rad=-0.174533,
    jaw_open_rad=1.74533,
    home_rad=(0.0, 0.05, -0.1, 1.62, 0.0),
    workspace_m=((0.08, -0.30, 0.010), (0.36, 0.30, 0.42)),
    ground=TABLE,
)
"""Source of axes, distances and position limits: TheRobotStudio/SO-ARM100, Simulation/SO101,
so101_new_calib. Source of speed and torque: data sheet of the STS3215 at 7.4 V (0.222 s for 60
degrees without load, 19 kg cm). At home the gripper points down to within a tenth of a degree.
"""
KOCH = LerobotArm(
    name="koch",
    base_link="koch_base",
    tcp_link="koch_tcp",
    jaw_links=("koch_gripper", "koch_moving_jaw"),
    lower_rad=(-2.2, -1.085, -1.51, -2.0, -3.14),
    upper_rad=(2.2, 1.085, 1.51, 2.0, 3.14),
    effort_nm=(1.5, 1.5, 0.52, 0.52, 0.52),
    jaw_closed_rad=0.0,
    jaw_open_rad=1.6,
    home_rad=(0.0, -0.4, -0.1, 1.645, 0.0),
    workspace_m=((0.05, -0.22, 0.010), (0.27, 0.22, 0.25)),
    ground=TABLE,
)
"""Koch v1.1. Source of axes, distances and position limits: google-deepmind/mujoco_menagerie,
low_cost_robot_arm. Source of speed and torque: data sheets of XL430-W250 and XL330-M288 at 12 V
and 5 V (61 and 103 turns a minute without load, 1.5 and 0.52 Nm).

Every joint is 0 in the middle of its range, as LeRobot calibrates it, and turns as that of the
same name of the SO-101. At home the TCP is 65 mm above the table.
"""
_FLOOR = Obstacle(
    name="floor", lower_m=np.array((-1.00, -1.00, -0.60)), upper_m=np.array((1.00, 1.00, 0.00))
)
LEKIWI = replace(
    SO101,
    name="lekiwi",
    base_link="lekiwi_base",
    carried=SO101,
    workspace_m=((0.10, -0.30, 0.010), (0.39, 0.30, 0.51)),
    ground=_FLOOR,
)
"""An SO-101 on a mobile base. The base frame is on the floor in the middle of the three wheels.
Source of where the arm stands: SIGRobotics-UIUC/LeKiwi, URDF (its axis 67 mm before the middle, its
foot 90 mm above the floor).
"""
