"""Construction of a policy's interface from the options."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from rn_backend_openpi.interface_options import InterfaceOptions, JointAction, PoseAction
from rn_backend_openpi.layout import Layout, Size
from rn_backend_openpi.profiles import PRESETS, Keys
from rn_backend_openpi.rows import (
    ONE_ARM,
    DeltaRows,
    JointRows,
    PoseRows,
    Rows,
    joints_by_arm,
)
from rn_backend_openpi.state import TermState
from rn_vla.tcp_actions import ActionLayout
from rn_vla.tcp_profiles import PROFILES
from rn_vla.tcp_state import StateLayout
from roboneuron import BackendSpec, ConfigurationError, ControlSpace

_OWN_IMAGES = MappingProxyType(
    {
        "primary": "observation/image",
        "wrist": "observation/wrist_image",
        "right_wrist": "observation/right_wrist_image",
    }
)
"""Of the profile 'own' without `image_keys`."""


def layout_of(options: InterfaceOptions) -> Layout:
    """The interface that these options describe; they name a profile.

    Raises:
        ConfigurationError: `joints` is missing, does not fit, or is unused.
    """
    assert options.profile is not None
    preset = PRESETS.get(options.profile)
    images = _OWN_IMAGES if preset is None else preset.images
    size: Size | None = None if preset is None else preset.size_px
    if options.image_size_px is not None:
        size = None if options.image_size_px == "raw" else options.image_size_px
    optional = frozenset(images) - {"primary"} if preset is None else preset.optional
    return Layout(
        name=options.profile,
        image_keys=options.image_keys or images,
        optional_roles=optional if options.image_keys is None else frozenset(),
        image_size_px=size,
        axes=options.image_axes or ("hwc" if preset is None else preset.axes),
        flip=options.image_flip,
        prompt_key=options.prompt_key,
        state=_state(options),
        rows=_rows(options),
    )


def served_layout(options: InterfaceOptions, spec: BackendSpec, space: ControlSpace) -> Layout:
    """The interface in which a server offers a backend, with the cameras that the backend reads.

    Args:
        options: those of the server.
        spec: descriptor of the backend.
        space: control space of its chunks.

    Raises:
        ConfigurationError: a camera has no key, or the profile's control space differs from the
            backend's.
    """
    layout = layout_of(options)
    lacking = [role for role in spec.cameras if role not in layout.image_keys]
    if lacking:
        raise ConfigurationError(
            f"The backend {spec.name!r} needs the camera {lacking[0]!r}; profile {layout.name!r} "
            f"has keys for {', '.join(layout.image_keys)}.",
            hint="Add it to image_keys.",
        )
    rows = layout.rows.space
    is_same = (rows.kind, rows.channels) == (space.kind, space.channels)
    if not is_same or (space.rate_hz and rows.rate_hz != space.rate_hz):
        raise ConfigurationError(
            f"The backend {spec.name!r} answers in {space.label!r}, profile {layout.name!r} is for "
            f"{rows.label!r}.",
            hint="Choose another profile, or none: RoboNeuron's robots need none.",
        )
    roles = (*spec.cameras, *spec.optional_cameras)
    keys = {role: key for role, key in layout.image_keys.items() if role in roles}
    optional = frozenset(keys) - frozenset(spec.cameras)
    return replace(layout, image_keys=keys, optional_roles=optional)


def _arms(options: InterfaceOptions) -> tuple[str, ...]:
    preset = PRESETS.get(options.profile or "")
    if preset is not None:
        return ONE_ARM if preset.rows is None else preset.rows.arms
    return options.arms or ONE_ARM


def _joints(options: InterfaceOptions) -> tuple[str, ...]:
    if options.joints is None:
        raise ConfigurationError(
            f"Profile {options.profile!r} needs the option 'joints': the robot's joints in the "
            "policy's order."
        )
    joints_by_arm(options.joints, _arms(options))
    return options.joints


def _rows(options: InterfaceOptions) -> Rows:
    base = np.array(options.base_position_m)
    preset = PRESETS.get(options.profile or "")
    if preset is not None and preset.rows is not None:
        names = _joints(options)
        wanted = preset.joints * len(_arms(options))
        if len(names) != wanted:
            raise ConfigurationError(
                f"The option 'joints' names {len(names)} joints, profile {options.profile!r} has "
                f"{wanted}.",
                hint="Name them in the policy's order, from the base to the tip of each arm.",
            )
        return replace(preset.rows, names=names)
    action = options.action
    if isinstance(action, JointAction):
        return JointRows(**action.model_dump(), arms=_arms(options), names=_joints(options))
    if isinstance(action, PoseAction):
        _refuse_joints(options)
        return PoseRows(
            rotation=action.rotation,
            gripper=action.gripper,
            rate_hz=action.rate_hz,
            arms=_arms(options),
            base_position_m=base,
        )
    _refuse_joints(options)
    if action is None:
        layout = PROFILES[options.profile or ""].action
    else:
        layout = ActionLayout(**action.model_dump(exclude={"kind"}))
    if layout.adds_state:
        raise ConfigurationError(
            "adds_state has no effect: a policy server adds the state itself.",
            hint="Leave it out.",
        )
    return DeltaRows(layout=layout, base_position_m=base)


def _refuse_joints(options: InterfaceOptions) -> None:
    """Raise ConfigurationError for joint names that are not used."""
    terms = {term for part in (options.state_keys or {}).values() for term in part}
    if options.joints is not None and "joints" not in terms:
        raise ConfigurationError(
            "The option 'joints' has no effect: the profile moves the TCP and its state holds no "
            "joints."
        )


def _state(options: InterfaceOptions) -> TermState:
    preset = PRESETS.get(options.profile or "")
    tcp = PROFILES.get(options.profile or "") if preset is None or preset.rows is None else None
    keys: Keys = options.state_keys or (MappingProxyType({}) if preset is None else preset.state)
    has_joints = any("joints" in terms for terms in keys.values())
    by_arm = joints_by_arm(_joints(options), _arms(options)) if has_joints else {}
    near = np.zeros(3) if tcp is None else tcp.state.rotvec_near_rad
    if options.rotvec_near_rad is not None:
        near = np.array(options.rotvec_near_rad)
    return TermState(
        parts={
            key: {
                arm: StateLayout(
                    terms=terms,
                    joint_names=by_arm.get(arm, ()) if "joints" in terms else (),
                    base_position_m=np.array(options.base_position_m),
                    rotvec_near_rad=near,
                    finger_travel_m=options.finger_travel_m,
                )
                for arm in _arms(options)
            }
            for key, terms in keys.items()
        }
    )
