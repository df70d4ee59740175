"""Construction of a policy's interface from the options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from rn_backend_openpi.conventions import NetworkUnits
from rn_backend_openpi.interface_options import InterfaceOptions, JointAction, PoseAction
from rn_backend_openpi.layout import Layout
from rn_backend_openpi.options import NormalisationOptions, PolicyOptions
from rn_backend_openpi.profiles import CAMERAS, PRESETS, STATE_KEYS, Preset
from rn_backend_openpi.rows import ONE_ARM, DeltaRows, JointRows, PoseRows, Rows, joints_by_arm
from rn_backend_openpi.state import TermState
from rn_vla.normalisation import read_openpi_scalings
from rn_vla.tcp_actions import ActionLayout
from rn_vla.tcp_profiles import PROFILES
from rn_vla.tcp_state import StateLayout
from roboneuron import BackendSpec, ConfigurationError, ControlSpace

_OWN = Preset(
    images=MappingProxyType(
        {
            "primary": "observation/image",
            "wrist": "observation/wrist_image",
            "right_wrist": "observation/right_wrist_image",
        }
    ),
    state=MappingProxyType({}),
    size_px=None,
    optional=frozenset({"wrist", "right_wrist"}),
)
"""The profile 'own' where the options say nothing else."""


def layout_of(options: InterfaceOptions) -> Layout:
    """The interface that these options describe; they name a profile.

    Raises:
        ConfigurationError: `joints` is missing, does not fit, or is unused.
    """
    assert options.profile is not None
    preset = PRESETS.get(options.profile, _OWN)
    size = options.image_size_px or preset.size_px
    arms = options.arms or (ONE_ARM if preset.rows is None else preset.rows.arms)
    return Layout(
        name=options.profile,
        image_keys=options.image_keys or preset.images,
        optional_roles=preset.optional if options.image_keys is None else frozenset(),
        image_size_px=None if size == "raw" else size,
        axes=options.image_axes or preset.axes,
        flip=options.image_flip,
        prompt_key=options.prompt_key,
        state=_state(options, preset, arms),
        rows=_rows(options, preset, arms),
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


def engine_layout(options: PolicyOptions) -> Layout:
    """As `layout_of`; with the names of the engine and the conversion to its units if there is one,
    except for DreamZero, which takes RoboArena's own.

    Raises:
        CheckpointError: the file with the statistics cannot be read.
        ConfigurationError: as `layout_of`, or the statistics are of fewer values than the
            profile's.
    """
    layout = layout_of(options)
    if options.engine is None or not options.is_bare:
        return layout
    cameras = CAMERAS.get(layout.name, CAMERAS[""])
    keys = {role: cameras[role] for role in layout.image_keys if role in cameras}
    state = actions = None
    given = options.normalisation
    if isinstance(given, NormalisationOptions):
        state, actions = read_openpi_scalings(given.file, given.kind)
        if actions.width < layout.rows.width:
            raise ConfigurationError(
                f"{given.file} (actions) has statistics of {actions.width} values, the profile has "
                f"{layout.rows.width}.",
                hint="Name the statistics of the served checkpoint.",
            )
    network = NetworkUnits(state_key=STATE_KEYS[options.engine], state=state, actions=actions)
    return replace(layout, image_keys=options.image_keys or keys, network=network)


def _joints(options: InterfaceOptions, arms: tuple[str, ...]) -> Mapping[str, tuple[str, ...]]:
    """The joints of each arm. Raises ConfigurationError if they are missing or do not fit."""
    if options.joints is None:
        raise ConfigurationError(
            f"Profile {options.profile!r} needs the option 'joints': the robot's joints in the "
            "policy's order."
        )
    return joints_by_arm(options.joints, arms)


def _rows(options: InterfaceOptions, preset: Preset, arms: tuple[str, ...]) -> Rows:
    action = options.action
    rows = JointRows(**action.model_dump(), arms=arms) if isinstance(action, JointAction) else None
    if rows := preset.rows or rows:
        each = _joints(options, arms)
        if preset.joints not in (0, len(each[arms[0]])):
            raise ConfigurationError(
                f"The option 'joints' names {len(options.joints or ())} joints, profile "
                f"{options.profile!r} has {preset.joints * len(arms)}.",
                hint="Name them in the policy's order, from the base to the tip of each arm.",
            )
        return replace(rows, names=options.joints or ())
    terms = {term for part in (options.state_keys or {}).values() for term in part}
    if options.joints is not None and "joints" not in terms:
        raise ConfigurationError(
            "The option 'joints' has no effect: the profile moves the TCP and its state holds no "
            "joints."
        )
    base = np.array(options.base_position_m)
    if isinstance(action, PoseAction):
        return PoseRows(**action.model_dump(), arms=arms, base_position_m=base)
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


def _state(options: InterfaceOptions, preset: Preset, arms: tuple[str, ...]) -> TermState:
    keys = options.state_keys or preset.state
    has_joints = any("joints" in terms for terms in keys.values())
    by_arm = _joints(options, arms) if has_joints else {}
    tcp = PROFILES.get(options.profile or "") if preset.rows is None else None
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
                for arm in arms
            }
            for key, terms in keys.items()
        }
    )
