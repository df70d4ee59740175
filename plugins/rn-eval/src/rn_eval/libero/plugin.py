"""Descriptors of this package: the suites "libero-spatial", "libero-object", "libero-goal" and
"libero-10", and the backend "noop".
"""

from __future__ import annotations

from collections.abc import Sequence

from rn_eval.hooks import SuiteSpec
from roboneuron import ActionSpace, BackendSpec, CameraSpec, DriverSpec, RobotSpec, hookimpl

MAX_ROWS = 64
AGENTVIEW, WRIST = "agentview", "robot0_eye_in_hand"
BODY = RobotSpec(
    name="libero-panda",
    summary="The Franka Panda of LIBERO's simulation; its base frame is the simulation's world "
    "frame",
    target="rn_eval.libero.body:profile",
    cameras=(CameraSpec(name=AGENTVIEW, role="primary"), CameraSpec(name=WRIST, role="wrist")),
    drivers=(
        DriverSpec(
            name="simulated",
            summary="driven by the suite",
            target="rn_eval.libero.process:SimulatorProcess",
            simulated=True,
        ),
    ),
)
_OPENVLA = ("profile=libero", 'image_steps=["jpeg_95", "resize_lanczos", "center_crop_90"]')
"""Image steps of the evaluation scripts after the rotation by 180 degrees, which the suite does."""
_OFT = (
    *_OPENVLA,
    "constants=libero",
    "proprio=true",
    "state_rotation=quaternion",
    'finger_joints=["panda_finger_joint1", "panda_finger_joint2"]',
)


def _options(suite: str) -> tuple[str, ...]:
    """Options with which the backends match the evaluation scripts. A key may also end in
    "_no_noops" in the checkpoint.
    """
    asked = {"openvla": _OPENVLA, "oft": _OFT, "oft-primary": _OFT}
    return tuple(
        f"{name}.{text}"
        for name, texts in asked.items()
        for text in (*texts, f"unnorm_key={suite}")
    )


def _suite(name: str, target: str, summary: str) -> SuiteSpec:
    return SuiteSpec(
        name=name.replace("_", "-"),
        summary=f"{summary}; 10 tasks, 50 initial states each, by the protocol of OpenVLA and OFT",
        target=f"rn_eval.libero.suite:{target}",
        config="rn_eval.libero.options:LiberoOptions",
        body=BODY,
        options=_options(name),
    )


@hookimpl
def roboneuron_suites() -> Sequence[SuiteSpec]:
    """The LIBERO suites."""
    return [
        _suite(
            "libero_spatial", "LiberoSpatial", "LIBERO-Spatial: the same objects in other places"
        ),
        _suite("libero_object", "LiberoObject", "LIBERO-Object: other objects"),
        _suite("libero_goal", "LiberoGoal", "LIBERO-Goal: other goals in one scene"),
        _suite("libero_10", "Libero10", "LIBERO-Long: ten long tasks"),
    ]


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """The policy that does nothing."""
    return [
        BackendSpec(
            name="noop",
            summary="Does nothing, gripper open: the baseline of an evaluation",
            target="rn_eval.libero.noop:NoopBackend",
            config="rn_eval.libero.noop:NoopOptions",
            cameras=("primary",),
            action_space=ActionSpace(horizon=MAX_ROWS, step_s=0.05),
        )
    ]
