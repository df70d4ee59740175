"""Construction of a policy's interface from the options."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from rn_backend_openpi.layout import Layout, Size
from rn_backend_openpi.options import (
    OWN,
    PLAIN,
    DeltaAction,
    InterfaceOptions,
    JointAction,
    PoseAction,
)
from rn_backend_openpi.profiles import PRESETS, JointMeaning, Keys
from rn_backend_openpi.rows import (
    ONE_ARM,
    DeltaRows,
    JointRows,
    PlainRows,
    PoseRows,
    Rows,
    joint_channels,
    joints_by_arm,
    pose_channels,
)
from rn_backend_openpi.state import StateCodec, TermState
from rn_backend_openpi.whole_state import WholeState
from rn_vla.tcp_actions import ActionLayout
from rn_vla.tcp_profiles import PROFILES
from rn_vla.tcp_state import StateLayout
from roboneuron import EE_DELTA, BackendSpec, ConfigurationError, ControlSpace

_PLAIN_IMAGES = MappingProxyType(
    {
        "primary": "observation/image",
        "wrist": "observation/wrist_image",
        "right_wrist": "observation/right_wrist_image",
    }
)


def layout_of(options: InterfaceOptions, space: ControlSpace | None = None) -> Layout:
    """The interface that these options describe.

    Args:
        options: those of the client or the server.
        space: control space of the profile 'roboneuron'; None if only the options define it.

    Raises:
        ConfigurationError: no profile is set, or `joints` is missing, does not fit, or is unused.
    """
    if options.profile is None:
        raise ConfigurationError(
            "The option 'profile' of 'openpi' is not set; choose one of "
            f"{', '.join((*PRESETS, PLAIN, OWN))}.",
            hint="The profile defines the served policy's inputs and its actions' meaning; it "
            "is never guessed.",
        )
    preset = PRESETS.get(options.profile)
    images = _PLAIN_IMAGES if preset is None else preset.images
    size: Size | None = None if preset is None else preset.size_px
    if options.image_size_px is not None:
        size = None if options.image_size_px == "raw" else options.image_size_px
    rows = _plain(space) if space and options.profile == PLAIN else _rows(options)
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
        rows=rows,
    )


def served_layout(options: InterfaceOptions, spec: BackendSpec, space: ControlSpace) -> Layout:
    """The interface in which a server offers a backend, with the cameras that the backend reads;
    without a profile that of the profile 'roboneuron', which fits every backend.

    Args:
        options: those of the server.
        spec: descriptor of the backend.
        space: control space of its chunks.

    Raises:
        ConfigurationError: a camera has no key, or the profile's control space differs from the
            backend's.
    """
    if options.profile is None:
        options = options.model_copy(update={"profile": PLAIN})
    is_told = options.model_fields_set & {"space", "rate_hz", "joints", "arms"}
    layout = layout_of(options, None if is_told else space)
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
            hint="Choose another profile; 'roboneuron' fits every backend.",
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
    return options.joints


def _rows(options: InterfaceOptions) -> Rows:
    base = np.array(options.base_position_m)
    preset = PRESETS.get(options.profile or "")
    if options.profile == PLAIN:
        return _plain(_plain_space(options))
    if preset is not None and preset.rows is not None:
        names = _joints(options)
        wanted = preset.joints * len(_arms(options))
        if len(names) != wanted:
            raise ConfigurationError(
                f"The option 'joints' names {len(names)} joints, profile {options.profile!r} has "
                f"{wanted}.",
                hint="Name them in the policy's order, from the base to the tip of each arm.",
            )
        return _joint_rows(preset.rows, names)
    action = options.action
    if isinstance(action, JointAction):
        meaning = JointMeaning(**action.model_dump(), arms=_arms(options))
        return _joint_rows(meaning, _joints(options))
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
    layout = PROFILES[options.profile or ""].action if action is None else _delta(action)
    if layout.adds_state:
        raise ConfigurationError(
            "adds_state has no effect: a policy server adds the state itself.",
            hint="Leave it out.",
        )
    return DeltaRows(layout=layout, base_position_m=base)


def _plain(space: ControlSpace) -> PlainRows:
    return PlainRows(space=space, step_s=1.0 / space.rate_hz if space.rate_hz else 0.0)


def _refuse_joints(options: InterfaceOptions) -> None:
    """Raise ConfigurationError for joint names that are not used."""
    terms = {term for part in (options.state_keys or {}).values() for term in part}
    if options.joints is not None and "joints" not in terms:
        raise ConfigurationError(
            "The option 'joints' has no effect: the profile moves the TCP and its state holds no "
            "joints."
        )


def _plain_space(options: InterfaceOptions) -> ControlSpace:
    if options.space == "ee_delta":
        return EE_DELTA
    if options.space == "ee_pose":
        channels = pose_channels(_arms(options), has_gripper=options.grippers)
    else:
        channels = joint_channels(
            options.space,
            _joints(options),
            _arms(options),
            has_gripper=options.grippers,
            slides=options.slides,
        )
    return ControlSpace(kind=options.space, channels=channels, rate_hz=options.rate_hz)


def _state(options: InterfaceOptions) -> StateCodec:
    if options.profile == PLAIN:
        return WholeState()
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


def _joint_rows(meaning: JointMeaning, names: tuple[str, ...]) -> JointRows:
    return JointRows(
        kind=meaning.kind,
        names=names,
        gripper=meaning.gripper,
        rate_hz=meaning.rate_hz,
        arms=meaning.arms,
        limit=meaning.limit,
        scale=meaning.scale,
    )


def _delta(action: DeltaAction) -> ActionLayout:
    return ActionLayout(**action.model_dump(exclude={"kind"}))
