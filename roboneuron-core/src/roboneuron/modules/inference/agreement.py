"""Agreement on a control space between a backend and the robot with its controller, by channel
names, units and frames, before anything heavy is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from roboneuron.config import models
from roboneuron.contract import (
    EE_DELTA,
    GRIPPER,
    SPACE_KINDS,
    ActionChunk,
    ControlSpace,
    JointSample,
    RobotProfile,
    robot_space,
)
from roboneuron.contract.arrays import F64
from roboneuron.errors import ConfigurationError, InvalidInputError, PlanningError, PluginError
from roboneuron.modules.plugin import load_profile
from roboneuron.plugins import loading
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import BackendSpec, ControllerSpec

__all__ = ["SpaceAgreement"]
"""Names that other distributions may use."""

_RATE_SHARE = 0.02
"""Relative tolerance between a chunk's period and the declared rate: rates are given in
whole Hz.
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class SpaceAgreement:
    """Conversion of a backend's rows for control.

    Attributes:
        declared: the backend's space.
        executed: the robot's space: the same channels in its own order; positions for
            `joint_delta`.
        columns: the declared column of each executed channel.
    """

    declared: ControlSpace
    executed: ControlSpace
    columns: tuple[int, ...]

    @classmethod
    def of(
        cls,
        registry: Registry,
        backend: BackendSpec,
        options: Mapping[str, object],
        robot: str,
        control: models.ControlConfig | None,
    ) -> SpaceAgreement:
        """Agree on a backend's space with these options and the configured controller.

        Args:
            registry: the installed plugins.
            backend: its descriptor.
            options: options of the backend, with its checkpoint.
            robot: name of the robot.
            control: section of the configuration; None to accept every space.

        Raises:
            PlanningError: they do not fit, see `agree`.
            ConfigurationError: only the model's server knows its space.
            ConfigurationError, PluginError: as `declared_space` and `agree_with_control`.
        """
        declared = declared_space(registry, backend, options, robot)
        if declared is None:
            raise ConfigurationError(
                f"In which space backend {backend.name!r} acts is known only by the server of its "
                "model.",
                hint=f"Say it: `space` in [plugins.{backend.name}].",
            )
        return agree_with_control(registry, backend, declared, robot, control)

    def convert(self, chunk: ActionChunk, joints: JointSample | None) -> ActionChunk:
        """Convert a chunk to the executed space.

        Args:
            chunk: answer of the backend.
            joints: measured with the observation of the chunk; needed for `joint_delta`.

        Raises:
            InvalidInputError: the chunk has another space or period than the backend declares, or
                joints of the space are missing.
        """
        if chunk.space is EE_DELTA and self.declared is EE_DELTA:
            return chunk
        if chunk.space != self.declared:
            alike = chunk.space.label == self.declared.label
            raise InvalidInputError(
                f"The backend answered in {_described(chunk.space)}"
                f"{' with other units or frames' if alike else ''}; it declares "
                f"{_described(self.declared)}."
            )
        rate_hz = self.declared.rate_hz
        if rate_hz and abs(chunk.step_s * rate_hz - 1.0) > _RATE_SHARE:
            raise InvalidInputError(
                f"The backend answered with {1.0 / chunk.step_s:.4g} rows a second; it declares "
                f"{rate_hz:g}."
            )
        actions = chunk.actions[:, self.columns]
        if self.declared.kind == "joint_delta":
            actions = actions + self._offsets(joints)
        return replace(chunk, actions=actions, space=self.executed)

    def _offsets(self, joints: JointSample | None) -> F64:
        """Offset of each column: the measured joint; 0 for a gripper."""
        measured = {GRIPPER: 0.0}
        if joints is not None:
            measured |= dict(zip(joints.names, joints.position.tolist(), strict=True))
        # the names of joints are distinct over all arms
        names = [channel.name for channel in self.executed.channels]
        missing = [name for name in names if name not in measured]
        if missing:
            raise InvalidInputError(
                f"The measured joints lack {', '.join(missing)}, to which the backend's deltas "
                "are relative."
            )
        return np.array([measured[name] for name in names])


def agree(
    declared: ControlSpace,
    profile: RobotProfile,
    kinds: Collection[str],
    *,
    backend: str,
    controller: str,
    longest_s: float | None = None,
) -> SpaceAgreement:
    """Compare both sides by the names of their channels.

    Args:
        declared: the backend's space.
        profile: profile of the robot.
        kinds: spaces that the controller executes.
        backend, controller: their names, for messages.
        longest_s: time without an action after which control holds [s]; None if unknown.

    Raises:
        PlanningError: names both sides, and every missing, extra or different channel.
    """
    kind = "joint_position" if declared.kind == "joint_delta" else declared.kind
    if kind not in kinds:
        raise PlanningError(
            f"Backend {backend!r} yields {_described(declared)}; controller {controller!r} "
            f"executes {', '.join(kinds)}.",
            hint=f"Choose a controller that executes {kind!r}.",
        )
    try:
        executed = robot_space(kind, profile, declared.rate_hz)
    except InvalidInputError as error:
        raise PlanningError(f"Backend {backend!r} does not fit: {error.message}") from error
    ours = {channel.key: channel for channel in executed.channels}
    theirs = {channel.key: channel for channel in declared.channels}
    problems = []
    if missing := [key for key in ours if key not in theirs]:
        problems.append(f"the backend lacks {', '.join(missing)}")
    if extra := [key for key in theirs if key not in ours]:
        problems.append(f"the robot lacks {', '.join(extra)}")
    for key in ours.keys() & theirs.keys():
        for what in ("unit", "frame"):
            mine, its = getattr(ours[key], what), getattr(theirs[key], what)
            if mine != its:
                problems.append(f"{what} of {key}: {its or 'none'!r}, expected {mine or 'none'!r}")
    if kind == "joint_velocity" and not declared.rate_hz:
        problems.append("the backend does not say how many rows a second it yields")
    if longest_s is not None and declared.rate_hz and 1.0 / declared.rate_hz > longest_s:
        problems.append(
            f"{declared.rate_hz:g} rows a second are too few: control holds {longest_s:g} s after "
            "the last one (control.action_timeout_s)"
        )
    if problems:
        raise PlanningError(
            f"Backend {backend!r} yields {_described(declared)}; robot {profile.name!r} executes "
            f"{_described(executed)}: {'; '.join(sorted(problems))}.",
            hint="Name the robot's joints, one for each of the policy's, in the options of the "
            "backend.",
        )
    keys = declared.keys
    return SpaceAgreement(
        declared=declared,
        executed=executed,
        columns=tuple(keys.index(key) for key in executed.keys),
    )


def check_same_space(first: SpaceAgreement, second: SpaceAgreement, name: str) -> None:
    """Raise PlanningError unless two policies have the same space: rows of both pass through one
    control.

    Args:
        first, second: agreement of each policy.
        name: name of the second's backend.
    """
    if first.executed.keys != second.executed.keys or first.executed.kind != second.executed.kind:
        raise PlanningError(
            f"The fallback {name!r} yields {_described(second.executed)}, the policy that it is to "
            f"stand in for {_described(first.executed)}.",
            hint="Choose a fallback that moves the robot in the same space, or none.",
        )


def _described(space: ControlSpace) -> str:
    relative = ", relative to the measured joints" if space.kind == "joint_delta" else ""
    rate = f" at {space.rate_hz:g} Hz" if space.rate_hz else ""
    return f"{space.kind} ({', '.join(space.keys)}{relative}{rate})"


def declared_space(
    registry: Registry, backend: BackendSpec, options: Mapping[str, object], robot: str
) -> ControlSpace | None:
    """Return the space that the backend declares with these options; None if only its model's
    server knows it (`ServedElsewhere`).

    Args:
        registry: the installed plugins.
        backend: its descriptor.
        options: options of the backend, with its checkpoint.
        robot: name of the robot.

    Raises:
        ConfigurationError, PluginError: a named part is unusable, or as the function that declares
            the space.
    """
    if backend.space is None:
        return EE_DELTA
    declare = cast(
        "Callable[..., object]",
        loading.load_attribute(backend.space, f"`space` of {backend.name!r}"),
    )
    declared = declare(options, load_profile(registry, robot))
    if declared is not None and not isinstance(declared, ControlSpace):
        raise PluginError(
            f"The `space` of {backend.name!r} returned {type(declared).__name__}, expected "
            "ControlSpace."
        )
    return declared


def agree_with_control(
    registry: Registry,
    backend: BackendSpec,
    declared: ControlSpace,
    robot: str,
    control: models.ControlConfig | None,
) -> SpaceAgreement:
    """Agree on a declared space with the configured controller.

    Args:
        registry: the installed plugins.
        backend: its descriptor.
        declared: space declared by it, or by its model's server.
        robot: name of the robot.
        control: section of the configuration; None to accept every space.

    Raises:
        PlanningError: they do not fit, see `agree`.
        ConfigurationError, PluginError: a named part is unusable, or the descriptor does not fit
            its space.
    """
    profile = load_profile(registry, robot)
    if declared.kind == "joint_delta" and not backend.needs_state:
        raise PluginError(
            f"Backend {backend.name!r} yields joint_delta, which is relative to the measured "
            "joints, but its descriptor does not say needs_state."
        )
    kinds: tuple[str, ...] = SPACE_KINDS
    name, longest_s = "", None
    if control is not None:
        name = control.controller
        kinds = registry.get(ControllerSpec, name, elsewhere=True).spaces
        longest_s = control.hold_after_s
    return agree(
        declared, profile, kinds, backend=backend.name, controller=name, longest_s=longest_s
    )
