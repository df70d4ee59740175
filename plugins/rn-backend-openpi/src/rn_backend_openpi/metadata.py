"""Metadata, a server's first message: those of RoboNeuron's server, and those of others that can be
compared with the configuration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from rn_backend_openpi.layout import Layout, Size
from rn_backend_openpi.wire import Value
from roboneuron import (
    Channel,
    ConfigurationError,
    ControlSpace,
    ForeignDataError,
    InvalidInputError,
    foreign,
)

PROTOCOL = 1
"""Version of the metadata that RoboNeuron's server adds to openpi's."""
SERVER = "roboneuron"
_ARENA_SPACES = {
    "joint_position": "joint_position",
    "joint_velocity": "joint_velocity",
    "cartesian_position": "ee_pose",
    "cartesian_velocity": "",
}
"""Spaces by RoboArena's names. Source: roboarena policy_server.py, PolicyServerConfig."""
_EXTERNAL = "exterior_image"
"""Substring of RoboArena's keys for cameras that are not at the wrist."""
_ACTIONS = "action.metadata"
_BARE_FAMILIES = ("pi05", "pi0")
"""Of SGLang: it neither normalises their state nor converts their rows back."""
_ARENA_MARKS = ("needs_session_id", "n_external_cameras", "needs_wrist_camera")


@dataclass(frozen=True, kw_only=True, slots=True)
class Told:
    """Result of comparing the metadata.

    Attributes:
        layout: the configured layout, completed with the server's values.
        is_roboneuron: the server reads the time left for an answer.
        is_roboarena: the server takes `endpoint` and `session_id`.
    """

    layout: Layout
    is_roboneuron: bool
    is_roboarena: bool


def describe(
    layout: Layout, *, backend: str, needed: Sequence[str], horizon: int
) -> dict[str, Value]:
    """The metadata of RoboNeuron's server.

    Args:
        layout: the served interface.
        backend: its name.
        needed: camera roles required in a request.
        horizon: largest number of rows in an answer.
    """
    rows, size = layout.rows, layout.image_size_px
    told: dict[str, Value] = {
        "server": SERVER,
        "protocol": PROTOCOL,
        "backend": backend,
        "profile": layout.name,
        "action_space": rows.space.kind,
        "action_channels": [
            {"name": c.name, "unit": c.unit, "frame": c.frame, "arm": c.arm}
            for c in rows.space.channels
        ],
        "action_rate_hz": rows.space.rate_hz,
        "action_dim": rows.width,
        "action_horizon": horizon,
        "step_s": rows.step_s,
        "image_keys": dict(layout.image_keys),
        "needed_cameras": list(needed),
        "image_resolution": None if size is None else list(size),
        "image_axes": layout.axes,
        "state_keys": list(layout.state.keys),
        "prompt_key": layout.prompt_key,
    }
    return told


def describe_arena(layout: Layout) -> dict[str, Value]:
    """The metadata of a server in RoboArena's dialect, whose clients accept no others.

    Raises:
        ConfigurationError: RoboArena has no name for the action space.
    """
    kinds = {kind: name for name, kind in _ARENA_SPACES.items()}
    kind = layout.rows.space.kind
    if kind not in kinds:
        raise ConfigurationError(
            f"RoboArena has no name for the action space {kind!r}.",
            hint="Leave the option 'dialect' out.",
        )
    keys, size = layout.image_keys.values(), layout.image_size_px
    external = [key for key in keys if _EXTERNAL in key]
    return {
        "image_resolution": None if size is None else list(size),
        "needs_wrist_camera": len(external) < len(keys),
        "n_external_cameras": len(external),
        "needs_stereo_camera": False,
        "needs_session_id": False,
        "action_space": kinds[kind],
    }


def check(
    metadata: Mapping[object, object], layout: Layout, *, size_is_set: bool, dialect: str
) -> Told:
    """Compare the server's metadata with the configuration.

    Args:
        metadata: the server's first message.
        layout: the configured layout.
        size_is_set: True if the user set the image size.
        dialect: the option `dialect`.

    Raises:
        ConfigurationError: they disagree; names both sides.
    """
    if metadata.get("object") == _ACTIONS:
        told = _for_actions(metadata, layout)
        return Told(layout=told, is_roboneuron=False, is_roboarena=dialect == "roboarena")
    is_ours = metadata.get("server") == SERVER
    if is_ours:
        layout = _check_ours(metadata, layout)
    elif isinstance(metadata.get("action_space"), str):
        _check_kind(str(metadata["action_space"]), layout)
    is_arena = not is_ours and any(mark in metadata for mark in _ARENA_MARKS)
    if layout.network is not None:
        layout = _padded(layout, metadata.get("action_dim", layout.rows.width))
    elif is_arena:
        layout = _with_cameras(metadata, layout)
    layout = _with_size(metadata, layout, size_is_set=size_is_set)
    return Told(
        layout=layout,
        is_roboneuron=is_ours,
        is_roboarena=dialect == "roboarena" or (dialect == "auto" and is_arena),
    )


def _for_actions(metadata: Mapping[object, object], layout: Layout) -> Layout:
    """The layout for the server of SGLang that sends these metadata.

    Raises:
        ConfigurationError: it would take the robot's units for the network's, or compute black for
            a camera that it does not know.
    """
    network, family = layout.network, str(metadata.get("policy_family"))
    if network is None or (network.actions is None and family in _BARE_FAMILIES):
        raise ConfigurationError(
            f"The server serves {family!r} bare: states and rows are in the network's units.",
            hint="Set engine = 'sglang' and the table [plugins.openpi.normalisation].",
        )
    try:
        given, output = foreign.field(metadata, "input"), foreign.field(metadata, "output")
        cameras = foreign.items(foreign.field(given, "image_keys"), "image_keys", most=16)
        width = foreign.field(output, "action_dim")
    except ForeignDataError as error:
        raise ConfigurationError(f"The server's metadata are malformed: {error}.") from error
    for role, key in layout.image_keys.items():
        if key.rpartition(".")[2] not in cameras and role not in layout.optional_roles:
            raise ConfigurationError(
                f"The server knows no camera {key!r} (role {role!r}) and would compute black for "
                f"it; its cameras: {', '.join(map(str, cameras))}.",
                hint="Correct image_keys.",
            )
    known = {role: k for role, k in layout.image_keys.items() if k.rpartition(".")[2] in cameras}
    return _padded(replace(layout, image_keys=known), width)


def _padded(layout: Layout, width: object) -> Layout:
    """The layout for served rows of that many values."""
    if not isinstance(width, int) or width < layout.rows.width or layout.network is None:
        raise ConfigurationError(
            f"The server's rows have {width!r} values, the profile's {layout.rows.width}.",
            hint="Choose the profile of the served policy.",
        )
    return replace(layout, network=replace(layout.network, width=width))


def _check_ours(metadata: Mapping[object, object], layout: Layout) -> Layout:
    if metadata.get("protocol") != PROTOCOL:
        raise ConfigurationError(
            f"The server speaks version {metadata.get('protocol')!r} of RoboNeuron's metadata, "
            f"this client version {PROTOCOL}.",
            hint="Bring both machines to the same release.",
        )
    if metadata.get("profile") != layout.name:
        raise ConfigurationError(
            f"The server's profile is {metadata.get('profile')!r}, the configuration says "
            f"{layout.name!r}.",
            hint="Write the same profile on both machines.",
        )
    _check_space(_space_of(metadata), layout.rows.space)
    needed = metadata.get("needed_cameras")
    keys = metadata.get("image_keys")
    if not isinstance(needed, list) or not isinstance(keys, dict):
        raise ConfigurationError("The server's metadata name no cameras.")
    for role in needed:
        if layout.image_keys.get(role) != keys.get(role):
            raise ConfigurationError(
                f"The server takes the camera {role!r} at {keys.get(role)!r}, the configuration "
                f"sends {layout.image_keys.get(role)!r}.",
                hint="Correct image_keys.",
            )
    for name, value in (
        ("image_axes", layout.axes),
        ("state_keys", list(layout.state.keys)),
        ("prompt_key", layout.prompt_key),
    ):
        if metadata.get(name) != value:
            raise ConfigurationError(
                f"{name} is {metadata.get(name)!r} at the server, {value!r} in the configuration.",
                hint="Write the same lines on both machines.",
            )
    return replace(layout, optional_roles=layout.optional_roles - set(needed))


def _space_of(metadata: Mapping[object, object]) -> ControlSpace:
    channels, rate_hz = metadata.get("action_channels"), metadata.get("action_rate_hz")
    try:
        if not isinstance(channels, list) or not isinstance(rate_hz, float | int):
            raise TypeError("no list of channels with a rate")
        return ControlSpace(
            kind=str(metadata.get("action_space")),
            channels=tuple(Channel(**channel) for channel in channels),
            rate_hz=float(rate_hz),
        )
    except (TypeError, InvalidInputError) as error:
        raise ConfigurationError(
            f"The server's metadata describe no control space: {error}."
        ) from error


def _check_space(served: ControlSpace, configured: ControlSpace) -> None:
    if served.label != configured.label:
        raise ConfigurationError(
            f"The server's actions are {served.label!r}, the configuration says "
            f"{configured.label!r}.",
            hint="Correct profile, space, joints or rate_hz of [plugins.openpi].",
        )
    for theirs, ours in zip(served.channels, configured.channels, strict=True):
        if theirs != ours:
            raise ConfigurationError(
                f"The server's {theirs.key} is in {theirs.unit!r} of frame {theirs.frame!r}, the "
                f"configuration says {ours.unit!r} of frame {ours.frame!r}.",
                hint="Correct the option 'slides' or the robot's profile on one side.",
            )


def _check_kind(told: str, layout: Layout) -> None:
    """Compare the configured control space with that of another server."""
    kind = _ARENA_SPACES.get(told, told)
    if kind != layout.rows.space.kind:
        raise ConfigurationError(
            f"The server's action space is {told!r}, the configuration says "
            f"{layout.rows.space.kind!r} (profile {layout.name!r}).",
            hint="Choose the profile of the served policy, or profile 'own' with the table "
            "'action'.",
        )


def _with_cameras(metadata: Mapping[object, object], layout: Layout) -> Layout:
    """The layout with the images that a RoboArena server requires; all of them become mandatory.

    Raises:
        ConfigurationError: the configuration has no key for one.
    """
    external = [role for role, key in layout.image_keys.items() if _EXTERNAL in key]
    wrist = [role for role, key in layout.image_keys.items() if _EXTERNAL not in key]
    count = metadata.get("n_external_cameras", len(external))
    needs_wrist = metadata.get("needs_wrist_camera", bool(wrist))
    lacks = ""
    if not isinstance(count, int) or count > len(external):
        lacks = f"{count!r} external cameras (image_keys has {len(external)})"
    elif needs_wrist and not wrist:
        lacks = "a wrist camera"
    elif metadata.get("needs_stereo_camera"):
        lacks = "both images of stereo cameras"
    if lacks:
        raise ConfigurationError(
            f"The policy server needs {lacks}.",
            hint="Add the roles to image_keys, as observation/exterior_image_0_left, "
            "observation/exterior_image_1_left, observation/wrist_image_left.",
        )
    assert isinstance(count, int)
    chosen = (*external[:count], *(wrist if needs_wrist else ()))
    keys = {role: layout.image_keys[role] for role in chosen}
    return replace(layout, image_keys=keys, optional_roles=frozenset())


def _with_size(metadata: Mapping[object, object], layout: Layout, *, size_is_set: bool) -> Layout:
    """The layout with the server's image size, if it gives one."""
    told = metadata.get("image_resolution")
    if not isinstance(told, list):
        return layout
    if len(told) != 2 or not all(type(side) is int and 0 < side <= 4096 for side in told):
        raise ConfigurationError(f"The server's image_resolution is {told!r}.")
    size: Size = (told[0], told[1])
    if size_is_set and size != layout.image_size_px:
        ours = layout.image_size_px
        raise ConfigurationError(
            f"The server takes images of {size[0]} x {size[1]} (height x width), image_size_px "
            f"says {'raw' if ours is None else f'{ours[0]} x {ours[1]}'}.",
            hint="Leave image_size_px out.",
        )
    return replace(layout, image_size_px=size)
