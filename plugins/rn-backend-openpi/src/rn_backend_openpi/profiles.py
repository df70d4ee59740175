"""Interfaces of public policies as openpi serves them, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from rn_backend_openpi.layout import Axes, Size
from rn_backend_openpi.rows import JointKind, JointRows
from rn_vla.tcp_profiles import PROFILES
from rn_vla.tcp_state import StateTerm

TWO_ARMS = ("left", "right")
Keys = Mapping[str, tuple[StateTerm, ...]]


@dataclass(frozen=True, kw_only=True, slots=True)
class Preset:
    """One named interface.

    Attributes:
        images: key by camera role.
        state: terms by key.
        rows: joint rows, without names; None for those of the TCP profile of the same name in
            `rn_vla.tcp_profiles`.
        size_px: height and width of the images; None for any.
        axes: order of the images' axes.
        optional: roles that may be missing, unless the server's metadata require them.
        joints: number of joints of each arm; 0 for policies that move the TCP.
    """

    images: Mapping[str, str]
    state: Keys
    rows: JointRows | None = None
    size_px: Size | None = (224, 224)
    axes: Axes = "hwc"
    optional: frozenset[str] = frozenset()
    joints: int = 0


_LIBERO_IMAGES = MappingProxyType(
    {"primary": "observation/image", "wrist": "observation/wrist_image"}
)
_DROID_IMAGES = MappingProxyType(
    {
        "primary": "observation/exterior_image_1_left",
        "wrist": "observation/wrist_image_left",
    }
)
_DROID_STATE: Keys = MappingProxyType(
    {
        "observation/joint_position": ("joints",),
        "observation/gripper_position": ("gripper_closed",),
    }
)
_STATE: Keys = MappingProxyType({"observation/state": ("joints", "gripper_closed")})
_ALOHA_IMAGES = MappingProxyType(
    {
        "primary": "images.cam_high",
        "wrist": "images.cam_left_wrist",
        "right_wrist": "images.cam_right_wrist",
    }
)
_ARENA_IMAGES = MappingProxyType(
    {
        "primary": "observation/exterior_image_0_left",
        "secondary": "observation/exterior_image_1_left",
        "wrist": "observation/wrist_image_left",
    }
)
_ARENA_STATE: Keys = MappingProxyType(
    {**_DROID_STATE, "observation/cartesian_position": ("position", "rpy")}
)


def _tcp_state(name: str) -> Keys:
    return MappingProxyType({"observation/state": PROFILES[name].state.terms})


def _droid(kind: JointKind, *, limit: float = 0.0, scale: float = 1.0) -> JointRows:
    return JointRows(kind=kind, rate_hz=15.0, gripper="closed_fraction", limit=limit, scale=scale)


PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        "libero": Preset(images=_LIBERO_IMAGES, state=_tcp_state("libero")),
        "bridge": Preset(images=_LIBERO_IMAGES, state=_tcp_state("bridge")),
        "droid": Preset(
            images=_DROID_IMAGES,
            state=_DROID_STATE,
            rows=_droid("joint_velocity", limit=1.0, scale=0.2 * 15.0),
            joints=7,
        ),
        "droid-position": Preset(
            images=_DROID_IMAGES,
            state=_DROID_STATE,
            rows=_droid("joint_position"),
            joints=7,
        ),
        "roboarena": Preset(
            images=_ARENA_IMAGES,
            state=_ARENA_STATE,
            rows=_droid("joint_position"),
            optional=frozenset({"secondary"}),
            joints=7,
        ),
        "franka": Preset(
            images=_LIBERO_IMAGES,
            state=_STATE,
            rows=JointRows(kind="joint_position", rate_hz=20.0, gripper="closed_fraction"),
            joints=7,
        ),
        "ur5e": Preset(
            images=MappingProxyType({"primary": "base_rgb", "wrist": "wrist_rgb"}),
            state=MappingProxyType({"joints": ("joints",), "gripper": ("gripper_closed",)}),
            rows=JointRows(kind="joint_position", rate_hz=20.0, gripper="closed_fraction"),
            joints=6,
        ),
        "aloha": Preset(
            images=_ALOHA_IMAGES,
            state=MappingProxyType({"state": ("joints", "gripper_open")}),
            rows=JointRows(
                kind="joint_position", rate_hz=50.0, gripper="open_fraction", arms=TWO_ARMS
            ),
            axes="chw",
            joints=6,
        ),
    }
)
"""Preset by name.

A policy server converts between its robot's software and the network, so states and actions are
those of that software: absolute joints, with the same signs. "libero", "bridge": see
`rn_vla.tcp_profiles`. "droid": joint velocities at 15 Hz as fractions of DROID's largest step of
0.2 rad in one period, so 1 is 3 rad/s; clipped to -1..1 as openpi's example does; gripper 0 open, 1
closed. Source: droid robot_ik_solver.py, openpi examples/droid. "droid-position": joint positions
instead. "roboarena": the same with the keys of RoboArena and DreamZero. Source: roboarena
policy_server.py. "franka": the space of the base models, 20 Hz, gripper 0 open. Source: openpi
docs/norm_stats.md. "ur5e": likewise, with the keys of openpi examples/ur5. "aloha": two arms at 50
Hz, images with the colour axis first in a map of their own, gripper 1 open; the server decides
whether `adapt_to_pi` is set and whether the network yields deltas. Source: openpi
examples/aloha_sim, policies/aloha_policy.py.
"""
STATE_KEYS = MappingProxyType({"sglang": "observation.state", "vllm-omni": "state"})
"""Key of the whole state at the engines that serve LeRobot checkpoints bare over openpi's
websocket: state and rows are in the network's units, which the client converts.

Sources (public definitions, read 2026-11): SGLang
multimodal_gen/runtime/entrypoints/action/{openpi,api,protocol,ws_utils}.py and its cookbook page of
pi0.5; vLLM-Omni vllm_omni/entrypoints/openpi, docs/serving/openpi_api.md, deploy/pi0.yaml.
"""
_IMAGES = "observation.images."
CAMERAS: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "": {
            "primary": _IMAGES + "base_0_rgb",
            "wrist": _IMAGES + "left_wrist_0_rgb",
            "right_wrist": _IMAGES + "right_wrist_0_rgb",
        },
        "libero": {"primary": _IMAGES + "image", "wrist": _IMAGES + "image2"},
    }
)
"""Keys of these engines' images by profile and camera role: those of the base models of pi0 and
pi0.5, which most checkpoints made from them have, and those of LeRobot's checkpoints for LIBERO.
"""
