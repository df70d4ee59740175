"""Descriptor of this package: the controller "urdf"."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import ControllerSpec, Requirement, hookimpl


@hookimpl
def roboneuron_controllers() -> Sequence[ControllerSpec]:
    """Offer the controller "urdf"."""
    return [
        ControllerSpec(
            name="urdf",
            summary="Inverse kinematics and joint motion for any URDF arm: within its limits or "
            "it holds",
            target="rn_controller_urdf.controller:UrdfController",
            config="rn_controller_urdf.options:UrdfControllerOptions",
            requires=(Requirement(module="pinocchio", install="pip install pin"),),
            robot_kinds=("arm",),
            spaces=("ee_delta", "ee_pose", "joint_position", "joint_velocity"),
        )
    ]
