"""Descriptors of this package: the robots "diffdrive", "husky" and "racecar", each with its
simulated driver.
"""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import DriverSpec, Requirement, RobotSpec, hookimpl

_ENGINE = Requirement(module="pybullet", alternatives=("mujoco",), install="pip install mujoco")
"""Copy of `rn_simulation.engine.REQUIREMENT`, because a plugin module imports no other package."""


def _base(name: str, summary: str) -> RobotSpec:
    return RobotSpec(
        name=name,
        summary=summary,
        target=f"rn_robot_bases.profile:{name}_profile",
        robot_kind="base",
        action_widths=(),
        drivers=(
            DriverSpec(
                name="simulated",
                summary="PyBullet or MuJoCo simulation on a flat floor, with wheel odometry",
                target="rn_robot_bases.driver:SimulatedBase",
                config="rn_robot_bases.options:SimulatedBaseOptions",
                simulated=True,
                requires=(_ENGINE,),
            ),
        ),
    )


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """The mobile bases."""
    return [
        _base(
            "diffdrive", "Small differential-drive base: two wheels and casters, turns on the spot"
        ),
        _base(
            "husky",
            "Four-wheeled skid-steered base of the size of a Clearpath Husky, turns on the spot",
        ),
        _base("racecar", "Scale model car with Ackermann steering: turning radius at least 0.75 m"),
    ]
