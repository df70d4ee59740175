"""The description of a server: its first message, as read by a robot and as written by our server.

Every server tells at least a map. What has one of our server's facts is at `RESERVED`; without it
the description has fewer facts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from rn_backend_openpi import messages
from rn_backend_openpi.layout import Layout, Size
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.wire import Value
from roboneuron import (
    MAX_SIDE_PX,
    ConfigurationError,
    ControlSpace,
    ForeignDataError,
    NotReadyError,
    RoboNeuronError,
    foreign,
)

PROTOCOL = 1
"""Version of the entries at `RESERVED`."""
LOADING, READY, FAILED = "loading", "ready", "failed"
"""States of a server."""
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
class ServerDescription:
    """What a server says first, or in its answer to an introduced robot.

    Attributes:
        told: the whole message.
        is_ours: it is of RoboNeuron's server, which reads the entries at `RESERVED`.
        state: `LOADING`, `READY` or `FAILED`.
        pid: pid of its process.
        cameras: roles that the model needs.
        optional_cameras: roles that it uses if present.
        image_sizes: width and height [px], by role, to which the model itself shrinks images.
        continues: chunks continue rows with a context that the server holds.
        horizon, step_s: rows of a chunk, and time between two [s], as declared by its backend.
        most_committed: see `BackendSpec.max_committed_rows`.
        takes_predicted_state: see `BackendSpec`.
        interface: for clients with a profile, see `facts_of`; None if the server offers none.
        space: control space of its chunks on the introduced robot; None without an introduction.
        refusal: error if that robot cannot use it, as a document.
        failure: error if it failed, as a document; None in other states.
        number: number before that of the robot's first request; random for each connection, so
            that a request is valid on one connection only.
    """

    told: Mapping[Any, object] = field(default_factory=dict)
    is_ours: bool = False
    state: str = READY
    pid: int = 0
    cameras: tuple[str, ...] = ()
    optional_cameras: tuple[str, ...] = ()
    image_sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    continues: bool = False
    horizon: int = 1
    step_s: float = 0.0
    most_committed: int = 0
    takes_predicted_state: bool = False
    interface: Document | None = None
    space: ControlSpace | None = None
    refusal: Document | None = None
    failure: Document | None = None
    number: int = 0

    @classmethod
    def of(cls, told: Mapping[Any, object]) -> ServerDescription:
        """Parse a received message.

        Raises:
            ConfigurationError: the server is of another version.
            ForeignDataError: a field is malformed.
        """
        if RESERVED not in told:
            return cls(told=told)
        own = foreign.table(told[RESERVED], RESERVED)
        if own.get("protocol") != PROTOCOL:
            raise ConfigurationError(
                f"The server uses version {own.get('protocol')!r} of RoboNeuron's entries, this "
                f"robot version {PROTOCOL}.",
                hint="Install the same release on both machines.",
            )
        sizes = foreign.table(own.get("image_sizes", {}), "image sizes", 16)
        return cls(
            told=told,
            is_ours=True,
            state=foreign.text(foreign.field(own, "state"), "state"),
            pid=foreign.integer(foreign.field(own, "pid"), "pid", 0),
            cameras=_roles(own, "cameras"),
            optional_cameras=_roles(own, "optional_cameras"),
            image_sizes={role: _size(size) for role, size in sizes.items()},
            continues=foreign.truth(own.get("continues", False), "continues"),
            horizon=foreign.integer(own.get("horizon", 1), "horizon", 1, messages.MOST_ROWS),
            step_s=foreign.number(own.get("step_s", 0.0), "step_s", 0.0),
            most_committed=foreign.integer(own.get("most_committed", 0), "most_committed", 0),
            takes_predicted_state=foreign.truth(own.get("takes_state", False), "takes_state"),
            interface=_table(own, "interface"),
            space=_space(own.get("space")),
            refusal=_table(own, "refusal"),
            failure=own if "error" in own else None,
            number=foreign.integer(own.get("number", 0), "number", 0),
        )

    def check_ready(self) -> None:
        """Raise the error of a server that failed, or ModelLoadingError if it is not ready yet."""
        if self.failure is not None:
            messages.raise_told(self.failure)
        if self.state != READY:
            raise ModelLoadingError("The model is being loaded.")


class ModelLoadingError(NotReadyError):
    """The model of the server is being loaded."""


def _roles(document: Document, name: str) -> tuple[str, ...]:
    roles = foreign.items(document.get(name, []), name, most=16)
    return tuple(foreign.text(role, "a role", 64) for role in roles)


def _table(document: Document, name: str) -> Document | None:
    found = document.get(name)
    return None if found is None else foreign.table(found, name, 16)


def _space(value: object) -> ControlSpace | None:
    try:
        return None if value is None else messages.to_space(value)
    except RoboNeuronError as error:
        raise ForeignDataError(f"the server sent an invalid control space: {error}") from error


def _size(value: object) -> tuple[int, int]:
    width, height = foreign.items(value, "an image size", most=2, least=2)
    most = MAX_SIDE_PX
    return foreign.integer(width, "a width", 1, most), foreign.integer(height, "a height", 1, most)


def facts_of(layout: Layout) -> Document:
    """What a client with a profile and its server have to agree on, in our server's description."""
    size = layout.image_size_px
    return {
        "profile": layout.name,
        "action_space": layout.rows.space.label,
        "image_axes": layout.axes,
        "state_keys": list(layout.state.keys),
        "prompt_key": layout.prompt_key,
        "image_keys": dict(layout.image_keys),
        "needed_cameras": [role for role in layout.image_keys if role not in layout.optional_roles],
        "image_resolution": None if size is None else list(size),
    }


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


def agreed(description: ServerDescription, layout: Layout, *, is_size_set: bool) -> Layout:
    """The configured layout, completed with what the server says.

    Args:
        description: of the server.
        layout: as configured.
        is_size_set: True if the user set the image size.

    Raises:
        ConfigurationError: they disagree; names both sides.
    """
    told: Mapping[Any, object] = description.told
    if told.get("object") == _ACTIONS:
        return _for_actions(told, layout)
    if description.is_ours:
        told = facts = _same_facts(description, layout)
        optional = layout.optional_roles - set(facts["needed_cameras"])
        layout = replace(layout, optional_roles=optional)
    elif isinstance(told.get("action_space"), str):
        _check_kind(str(told["action_space"]), layout)
    if layout.network is not None:
        layout = _padded(layout, told.get("action_dim", layout.rows.width))
    elif is_arena(description):
        layout = _with_cameras(told, layout)
    return _with_size(told, layout, is_size_set=is_size_set)


def is_arena(description: ServerDescription) -> bool:
    """True if the server takes `endpoint` and `session_id`, as RoboArena's do."""
    return not description.is_ours and any(mark in description.told for mark in _ARENA_MARKS)


def _same_facts(description: ServerDescription, layout: Layout) -> Document:
    """The interface of our server. Raises ConfigurationError if it is another one."""
    told, ours = description.interface, facts_of(layout)
    if told is None:
        raise ConfigurationError(
            "The model of this server has no `interface`, the configuration names the profile "
            f"{layout.name!r}.",
            hint="Leave profile out, or add the interface to the server's [models.NAME].",
        )
    keys, needed = told.get("image_keys"), told.get("needed_cameras")
    if not isinstance(needed, list) or not isinstance(keys, dict):
        raise ConfigurationError(
            "The server's interface names no cameras.",
            hint="Install the same release on both machines.",
        )
    needed = [str(role) for role in needed]
    same = ("profile", "action_space", "image_axes", "state_keys", "prompt_key")
    pairs = [(name, told.get(name), ours[name]) for name in same]
    pairs += [
        (f"the key of the camera {role!r}", keys.get(role), layout.image_keys.get(role))
        for role in needed
    ]
    for name, theirs, configured in pairs:
        if theirs != configured:
            raise ConfigurationError(
                f"{name} is {theirs!r} at the server, {configured!r} in the configuration.",
                hint="Write the same lines on both machines.",
            )
    return {**told, "needed_cameras": needed}


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


def _with_size(metadata: Mapping[object, object], layout: Layout, *, is_size_set: bool) -> Layout:
    """The layout with the server's image size, if it gives one."""
    told = metadata.get("image_resolution")
    if not isinstance(told, list):
        return layout
    if len(told) != 2 or not all(type(side) is int and 0 < side <= 4096 for side in told):
        raise ConfigurationError(f"The server's image_resolution is {told!r}.")
    size: Size = (told[0], told[1])
    if is_size_set and size != layout.image_size_px:
        ours = layout.image_size_px
        raise ConfigurationError(
            f"The server takes images of {size[0]} x {size[1]} (height x width), image_size_px "
            f"says {'raw' if ours is None else f'{ours[0]} x {ours[1]}'}.",
            hint="Leave image_size_px out.",
        )
    return replace(layout, image_size_px=size)
