"""Mapping of a configured policy to a robot: its numbers by name, its images by role."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rn_backend_lerobot.channels import Columns, Meaning
from rn_backend_lerobot.checkpoint import IMAGES, STATE, ImageFeature, PolicyFolder, read_folder
from rn_backend_lerobot.options import LeRobotOptions
from rn_vla.checkpoint_files import list_names
from roboneuron import ConfigurationError, ControlSpace, Frame, Observation, UngroundedError

LEFT_OUT = "-"


@dataclass(frozen=True, kw_only=True, slots=True)
class Wiring:
    """A policy with the mapping of its inputs and outputs to the robot.

    Attributes:
        folder: the checkpoint.
        action, state: its numbers, in order.
        space: control space of the rows.
        roles: camera role by the key of the image; "" for one that is named like a role or a
            camera, `LEFT_OUT` for none.
    """

    folder: PolicyFolder
    action: Columns
    state: Columns
    space: ControlSpace
    roles: Mapping[str, str]

    @property
    def images(self) -> tuple[ImageFeature, ...]:
        """Images that are given to the policy."""
        return tuple(one for one in self.folder.images if self.roles[one.key] != LEFT_OUT)

    def frame(self, image: ImageFeature, observation: Observation) -> Frame:
        """The camera frame for that image.

        Raises:
            UngroundedError: no camera provides it.
        """
        role = self.roles[image.key]
        found = observation.frames.get(role or image.short)
        if found is None and not role:
            named = [f for f in observation.frames.values() if f.camera == image.short]
            found = named[0] if named else None
        if found is None:
            have = ", ".join(f"{r} ({f.camera})" for r, f in observation.frames.items()) or "none"
            raise UngroundedError(
                f"The policy's image {image.key!r} needs the camera {role or image.short!r}; the "
                f"observation has: {have}."
            )
        return found


def wire(options: LeRobotOptions) -> Wiring:
    """Read the checkpoint and map each of its numbers and images to the robot.

    Raises:
        CheckpointError: see `read_folder`.
        ConfigurationError: a number is not mapped, does not exist, or has another unit; an image
            has no role.
    """
    folder = read_folder(options.checkpoint, options.folders)
    meanings = options.meanings()
    names = _names(folder, options)
    _check_width("action", names, folder.action, folder)
    action = [_mapped(name, meanings, "action") for name in names]
    state: list[Meaning] = []
    if folder.state:
        state_names = options.state_names or names
        _check_width(STATE, state_names, folder.state, folder)
        state = [_mapped(name, meanings, STATE) for name in state_names]
    unused = sorted(set(meanings) - {meaning.name for meaning in (*action, *state)})
    if unused:
        raise ConfigurationError(
            f"The option 'channels' names {list_names(unused)}, which the policy does not have; it "
            f"has {list_names(names)}."
        )
    channels = tuple(meaning.channel(options.space) for meaning in action)
    targets = [channel.key for channel in channels]
    twice = sorted({key for key in targets if targets.count(key) > 1})
    if twice:
        raise ConfigurationError(f"Two numbers of the action are mapped to {list_names(twice)}.")
    if options.action_steps is not None and folder.remembers and options.action_steps > 1:
        raise ConfigurationError(
            f"action_steps is {options.action_steps}, but a {folder.family} policy that remembers "
            "observations is queried row by row."
        )
    return Wiring(
        folder=folder,
        action=Columns(action),
        state=Columns(state),
        space=ControlSpace(kind=options.space, channels=channels, rate_hz=options.rate_hz),
        roles=_roles(folder, options.cameras),
    )


def _names(folder: PolicyFolder, options: LeRobotOptions) -> Sequence[str]:
    """Names of the action's values in the policy's order."""
    if options.joints is not None:
        return options.joints
    if options.names is None:
        if not folder.names:
            raise ConfigurationError(
                f"{folder.directory} does not name the {folder.action} values of its action.",
                hint="Set names to those of the training data, in its order (meta/info.json: "
                "features.action.names).",
            )
        return folder.names
    if folder.names and options.names != folder.names:
        raise ConfigurationError(
            f"The option 'names' is {list(options.names)}, the checkpoint says "
            f"{list(folder.names)}."
        )
    return options.names


def _check_width(what: str, names: Sequence[str], width: int, folder: PolicyFolder) -> None:
    if len(names) != width or len(set(names)) != width:
        raise ConfigurationError(
            f"{what!r} of {folder.directory} has {width} values; {len(set(names))} are named: "
            f"{list_names(names)}."
        )


def _mapped(name: str, meanings: Mapping[str, Meaning], what: str) -> Meaning:
    if name not in meanings:
        raise ConfigurationError(
            f"Nothing is mapped to {name!r} of the policy's {what!r}.",
            hint=f'Say what it is: [plugins.lerobot.channels] "{name}" = {{ to = "JOINT", unit = '
            '"degrees" }',
        )
    return meanings[name]


def _roles(folder: PolicyFolder, cameras: Mapping[str, str]) -> dict[str, str]:
    """Camera role by the key of each image; see `Wiring.roles`."""
    known = {image.key for image in folder.images}
    given = {key if key in known else f"{IMAGES}{key}": role for key, role in cameras.items()}
    unknown = sorted(set(given) - known)
    if unknown:
        raise ConfigurationError(
            f"The option 'cameras' names {list_names(unknown)}, which the policy does not take; it "
            f"takes {list_names(sorted(known)) or 'no image'}."
        )
    used = [role for role in given.values() if role != LEFT_OUT]
    if len(set(used)) != len(used):
        raise ConfigurationError(f"The option 'cameras' names a role twice: {', '.join(used)}.")
    return {image.key: given.get(image.key, "") for image in folder.images}
