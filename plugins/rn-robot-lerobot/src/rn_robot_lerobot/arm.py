"""LeRobot's arms as data: joints, limits, postures and surroundings. All have the joints of the
SO-101.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.resources import files
from xml.etree import ElementTree

import numpy as np

from roboneuron import JointLimits, Obstacle, Workspace

ARM_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
"""Names of the arm's joints, base to tip, as LeRobot's motors are named."""
GRIPPER_JOINT = "gripper"
"""The revolute joint of the moving jaw."""
JOINTS = (*ARM_JOINTS, GRIPPER_JOINT)
"""All joints, in the order of all joint arrays of this package and of the motor ids 1..6."""
Point = tuple[float, float, float]
FIVE = tuple[float, float, float, float, float]


@dataclass(frozen=True, kw_only=True, slots=True)
class LerobotArm:
    """One kind of arm; joint values in the order of `ARM_JOINTS`.

    Attributes:
        name: name of the robot, and of its URDF in `data`.
        base_link, tcp_link, jaw_links: links of the URDF.
        lower_rad, upper_rad: position limits.
        effort_nm: torque limits of the motors.
        jaw_closed_rad, jaw_open_rad: positions of the gripper's joint.
        home_rad: home posture, with the gripper pointing down above its workspace.
        workspace_m: lower and upper corner for the TCP; at the lowest height the tips of the jaws,
            8 mm beyond the TCP, are still above the ground.
        ground: the surface under the arm and the space below it.
        carried: an arm whose links are added to those of the URDF.
        velocity_rad_s, acceleration_rad_s2: limits of every joint. The first is two thirds of the
            no-load speed of an SO-101's motors and half of a Koch arm's; the second is an estimate,
            because LeRobot lets the motors accelerate as fast as they can.
        jaw_effort_nm: LeRobot's limit of the gripper's motor; 6 N at the tip.
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
        """Workspace of the TCP, in the base frame."""
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
so101_new_calib. Source of speed and torque: data sheet of the STS3215 at 7.4 V (no load: 0.222 s
for 60 degrees; 19 kg cm). At home the gripper points down to within a tenth of a degree.
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
low_cost_robot_arm. Source of speed and torque: data sheets of XL430-W250 and XL330-M288 at 12 V and
5 V (no load: 61 and 103 rpm; 1.5 and 0.52 Nm).

Every joint is 0 in the middle of its range, as LeRobot calibrates it, and has the same direction as
the SO-101's joint of that name. At home the TCP is 65 mm above the table.
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
Source of the arm's pose: SIGRobotics-UIUC/LeKiwi, URDF (its axis 67 mm in front of the middle, its
foot 90 mm above the floor).
"""
