"""Permissions of a client that starts a module: options, and paths of checkpoints."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from roboneuron.config.models import Config
from roboneuron.errors import (
    CheckpointError,
    ConfigurationError,
    MissingDependencyError,
    PluginError,
    RefusedError,
    nearest,
)
from roboneuron.gate.roles import Role
from roboneuron.plugins import loading
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import DriverSpec, Spec
from roboneuron.selection.options import selection_options
from roboneuron.selection.restricted import restricted_values, unnamed_addresses

_ABSENT = object()


def check_may_set(
    spec: Spec | DriverSpec,
    name: str,
    configured: Mapping[str, object],
    wanted: Mapping[str, object],
    listed: Collection[str],
    role: str,
) -> None:
    """Refuse a change of options that only the configuration may set; listed ones may be set by
    admins.

    A client's table replaces the whole table, so a restricted option may be neither changed, added
    nor left out.

    Args:
        spec: descriptor with the options.
        name: name of their section, `[plugins.<name>]`.
        configured, wanted: without and with the client's options.
        listed: `agent_options` of `[selection]`.
        role: role of the client.

    Raises:
        RefusedError: names the options.
    """
    if spec.config is None:
        return  # there are no options; the given one is refused as unknown
    try:
        model = loading.load_options_model(spec)
    except (
        MissingDependencyError
    ):  # a plugin for its own interpreter: the meaning of its options is unknown here
        model = None
    fixed, given = restricted_values(model, configured), restricted_values(model, wanted)
    changed = [
        key for key in {**fixed, **given} if fixed.get(key, _ABSENT) != given.get(key, _ABSENT)
    ]
    if model is not None:  # an unknown option is refused as such, with the nearest known one
        known = {field.alias or option for option, field in model.model_fields.items()}
        known |= loading.old_keys(model).keys()  # read from a file: what they name is restricted
        changed = [key for key in changed if "." in key or key in known]
    keys = [f"{name}.{key}" for key in changed]
    barred = [
        key
        for key in keys
        if not any(key == entry or key.startswith(f"{entry}.") for entry in listed)
    ]
    if f"{name}.checkpoint" in barred:
        raise RefusedError(
            "A checkpoint is no option for clients.",
            hint="Name it in the argument `checkpoint`.",
            rule="configuration",
        )
    if barred:
        raise RefusedError(
            f"Only the configuration may set {_list(barred)}.",
            hint="A person can set it there, or list it in agent_options of [selection] for "
            "admins.",
            rule="configuration",
        )
    if keys and role != Role.ADMIN:
        raise RefusedError(
            f"Only a client with the role 'admin' may set {_list(keys)}.",
            hint="Ask a person who has it.",
            rule="role",
        )


def check_listed(entries: Collection[str], registry: Registry) -> None:
    """Refuse unknown options in `agent_options`.

    Raises:
        ConfigurationError: names the entry, and the nearest option.
    """
    for entry in entries:
        name, *path = entry.split(".")
        registry.check_name(f"agent_options {entry!r}", name)
        try:
            models = [loading.load_options_model(spec) for spec in registry.readers_of(name)]
        except (MissingDependencyError, PluginError):
            continue  # cannot be checked here; reported where it is chosen
        known = {
            field.alias or key
            for model in models
            if model is not None
            for key, field in model.model_fields.items()
        }
        if path[0] not in known:
            listed = ", ".join(sorted(known)) or "none"
            raise ConfigurationError(
                f"agent_options {entry!r}: {name!r} has no option {path[0]!r}. "
                f"{nearest(path[0], known, f'Its options: {listed}.')}"
            )


def check_addresses(spec: Spec | DriverSpec, options: Mapping[str, object]) -> None:
    """Refuse an agent's choice of a plugin with an unconfigured network address: a process at that
    address would receive images and instructions, and control the robot's motion.

    Args:
        spec: the plugin, chosen by the agent and not by the configuration.
        options: options of its section, `[plugins.<name>]`.

    Raises:
        RefusedError: names the options.
    """
    try:
        model = loading.load_options_model(spec)
    except MissingDependencyError:
        return  # reported when it is selected
    absent = (
        []
        if model is None
        else [f"{spec.name}.{name}" for name in unnamed_addresses(model, options)]
    )
    if absent:
        raise RefusedError(
            f"{spec.name!r} would connect to a default address that the configuration does not "
            f"name: {_list(absent)}.",
            hint="A person writes the address into the configuration.",
            rule="configuration",
        )


def _list(keys: Collection[str]) -> str:
    return ", ".join(f"plugins.{key}" for key in keys)


def check_may_load(config: Config, checkpoint: str) -> None:
    """Refuse a client's path that lies neither below a configured checkpoint nor below a checkpoint
    root.

    Raises:
        RefusedError: it lies outside; checked before its existence.
        CheckpointError: it is not a valid path.
    """
    named = [config.inference.checkpoint if config.inference else None]
    named += [options.get("checkpoint") for options in config.plugins.values()]
    roots = selection_options(config).checkpoint_roots
    allowed = [path for path in (*named, *roots) if isinstance(path, str) and path]
    try:
        wanted = _resolve(checkpoint)
        if any(wanted.is_relative_to(_resolve(path)) for path in allowed):
            return
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, an unknown user, a NUL
        raise CheckpointError(
            f"The checkpoint {checkpoint!r} is no usable path: {error}."
        ) from error
    raise RefusedError(
        f"The configuration does not allow the checkpoint {checkpoint!r}.",
        hint=f"Allowed folders: {', '.join(allowed) or 'nothing yet'}. A person can add a "
        "folder of models to "
        "checkpoint_roots in [selection].",
        rule="configuration",
    )


def _resolve(path: str) -> Path:
    return Path(path).expanduser().resolve()
